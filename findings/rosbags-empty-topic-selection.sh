#!/usr/bin/env bash
# rosbags 0.11.9: a selection of connections that matches no topic reads every message of the bag. The usual filter,
# `reader.messages([c for c in reader.connections if c.topic == topic])`, gives the messages of all topics when the name
# is misspelt or the bag lacks the topic: here the mean of /left is 1, of /rigth 1.5. No error, no warning.
# Why: an empty selection is the default and disables the filter, as the docstring of `messages` states. Reader and
# AnyReader do so for MCAP, SQLite and ROS 1 bags. The reader of the package mcap returns no message for such a topic.
# Raise an error where the list of connections is empty.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check rosbags==0.11.9 mcap==1.6.0 numpy==2.4.6 \
    apsw==3.54.1.0 lz4==4.4.5 ruamel.yaml==0.19.1 typing_extensions==4.16.0 zstandard==0.25.0
venv/bin/python - <<'PYTHON'
from importlib.metadata import version
from pathlib import Path

from mcap.reader import make_reader
from rosbags import rosbag1, rosbag2
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

TYPE = "std_msgs/msg/Float64"
TOPICS = {"/left": 1.0, "/right": 2.0}
TIMES = range(0, 4_000_000, 1_000_000)  # ns
ros1, ros2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)


def write(writer, types, serialize):
    """Write four messages a topic; every message of a topic has the same value."""
    with writer:
        for topic, value in TOPICS.items():
            connection = writer.add_connection(topic, TYPE, typestore=types)
            for time in TIMES:
                writer.write(connection, time, serialize(types.types[TYPE](data=value), TYPE))


def read(reader, topic, deserialize):
    """Return the number of messages and the mean of their values."""
    with reader:
        connections = [connection for connection in reader.connections if connection.topic == topic]
        values = [deserialize(raw, c.msgtype).data for c, _, raw in reader.messages(connections)]
    return len(values), sum(values) / max(len(values), 1)


print("rosbags", version("rosbags"), "mcap", version("mcap"))
mcap, sqlite, bag = Path("mcap"), Path("sqlite"), Path("ros1.bag")
write(rosbag2.Writer(mcap, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP), ros2, ros2.serialize_cdr)
write(rosbag2.Writer(sqlite, version=9, storage_plugin=rosbag2.StoragePlugin.SQLITE3), ros2, ros2.serialize_cdr)
write(rosbag1.Writer(bag), ros1, ros1.serialize_ros1)
for path, reader, deserialize in (
    (mcap, rosbag2.Reader, ros2.deserialize_cdr),
    (sqlite, rosbag2.Reader, ros2.deserialize_cdr),
    (bag, rosbag1.Reader, ros1.deserialize_ros1),
):
    for name in ("Reader", "AnyReader"):
        results = {}
        for topic in ("/left", "/right", "/rigth"):
            results[topic] = read(reader(path) if name == "Reader" else AnyReader([path]), topic, deserialize)
        print(f"{path} by {name}:", results)
        assert results == {"/left": (4, 1.0), "/right": (4, 2.0), "/rigth": (8, 1.5)}, "behaviour has changed"
counts = {}
for topics in (["/left"], ["/rigth"], []):
    with open(next(mcap.glob("*.mcap")), "rb") as file:
        counts[str(topics)] = sum(1 for _ in make_reader(file).iter_messages(topics=topics))
print("control, messages by the package mcap:", counts)
assert counts == {"['/left']": 4, "['/rigth']": 0, "[]": 0}
PYTHON
echo "still so"
# Output of 2026-11-28, Python 3.11 on x86-64:
#   rosbags 0.11.9 mcap 1.6.0
#   mcap by Reader: {'/left': (4, 1.0), '/right': (4, 2.0), '/rigth': (8, 1.5)}
#   mcap by AnyReader: {'/left': (4, 1.0), '/right': (4, 2.0), '/rigth': (8, 1.5)}
#   sqlite by Reader: {'/left': (4, 1.0), '/right': (4, 2.0), '/rigth': (8, 1.5)}
#   sqlite by AnyReader: {'/left': (4, 1.0), '/right': (4, 2.0), '/rigth': (8, 1.5)}
#   ros1.bag by Reader: {'/left': (4, 1.0), '/right': (4, 2.0), '/rigth': (8, 1.5)}
#   ros1.bag by AnyReader: {'/left': (4, 1.0), '/right': (4, 2.0), '/rigth': (8, 1.5)}
#   control, messages by the package mcap: {"['/left']": 4, "['/rigth']": 0, '[]': 0}
#   still so
