#!/usr/bin/env bash
# rosbags 0.11.9: an MCAP recording whose header has no profile is refused, though its schemas (ros2msg) and messages
# (CDR) are those of ROS 2. MCAP's header allows an empty profile, and mcap 1.6.0 writes one unless told otherwise; so
# do recorders that are not rosbag2. The reader of the package mcap reads the same messages from both files.
# Why: rosbags compares the profile with 'ros2' before it looks at schemas and encodings.
# Write the profile 'ros2' where recordings are to be read by rosbags.
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
from mcap.writer import Writer
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

TYPE = "std_msgs/msg/Float64"
types = get_typestore(Stores.ROS2_HUMBLE)


def write(path: Path, **options: str) -> None:
    """Write three messages of one topic; options: of the recording's header."""
    with open(path, "wb") as file:
        writer = Writer(file)
        writer.start(**options)
        schema = writer.register_schema(name=TYPE, encoding="ros2msg", data=b"float64 data\n")
        channel = writer.register_channel(topic="/jaw", message_encoding="cdr", schema_id=schema)
        for index in range(3):
            message = bytes(types.serialize_cdr(types.types[TYPE](data=0.5 * index), TYPE))
            writer.add_message(channel, log_time=index, publish_time=index, data=message)
        writer.finish()


def by_rosbags(path: Path) -> str:
    """Return the values that rosbags reads, or its refusal."""
    try:
        with AnyReader([path], default_typestore=types) as reader:
            return str([reader.deserialize(raw, c.msgtype).data for c, _, raw in reader.messages()])
    except Exception as error:
        return f"{type(error).__name__}: {error}".replace(str(path), path.name)


def by_mcap(path: Path) -> str:
    """Return the values that the package mcap reads."""
    with open(path, "rb") as file:
        messages = make_reader(file).iter_messages()
        return str([types.deserialize_cdr(message.data, TYPE).data for _, _, message in messages])


print("rosbags", version("rosbags"), "mcap", version("mcap"))
named, unnamed = Path("named.mcap"), Path("unnamed.mcap")
write(named, profile="ros2")
write(unnamed)
results = {path.name: (by_rosbags(path), by_mcap(path)) for path in (named, unnamed)}
for name, (first, second) in results.items():
    print(f"{name}: rosbags {first}; mcap {second}")
assert results["named.mcap"] == ("[0.0, 0.5, 1.0]",) * 2, "behaviour has changed"
assert results["unnamed.mcap"][1] == "[0.0, 0.5, 1.0]", "behaviour has changed"
assert "rofile" in results["unnamed.mcap"][0], "behaviour has changed"
PYTHON
echo "still so"
# Output of 2026-11-29, Python 3.11 on x86-64:
#   rosbags 0.11.9 mcap 1.6.0
#   named.mcap: rosbags [0.0, 0.5, 1.0]; mcap [0.0, 0.5, 1.0]
#   unnamed.mcap: rosbags AnyReaderError: Profile is not ros2.; mcap [0.0, 0.5, 1.0]
#   still so
