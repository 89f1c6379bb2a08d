"""Ray: on this machine, or the cluster that RAY_ADDRESS names."""

from __future__ import annotations

import importlib.util
import logging
import os
import secrets
import socket
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from neeco.errors import NeecoError

CONNECT = 5.0  # s that a cluster's head gets to answer
PROBE_S = 60.0  # that a cluster's nodes get to start a worker and look at a folder


def address() -> str | None:
    """Of the cluster to work on; None: this machine."""
    return os.environ.get("RAY_ADDRESS") or None


def require_ray() -> None:
    """Raises NeecoError when Ray is not installed, or nobody listens at the HOST:PORT that RAY_ADDRESS names."""
    if importlib.util.find_spec("ray") is None:
        remedy = "unset RAY_ADDRESS" if address() else "leave --workers out"
        raise NeecoError(f"--workers: several at once need Ray; install neeco[cluster], or {remedy}")
    given = address() or ""
    host, _, port = given.rpartition(":")
    if "/" in given or not (host and port.isdecimal()):  # ray://..., auto, local: for Ray to understand
        return
    try:
        socket.create_connection((host, int(port)), CONNECT).close()
    except (OSError, OverflowError) as error:
        raise NeecoError(
            f"RAY_ADDRESS: no Ray cluster answers at {given} ({error}); start it, or unset RAY_ADDRESS to work here"
        ) from None


@contextmanager
def joined(cores: int) -> Iterator[Any]:
    """The module `ray`, joined to the cluster that RAY_ADDRESS names, else to one of so many cores of this machine that
    ends with the block. Raises NeecoError where there is none."""
    require_ray()
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_EXPERIMENTAL_NOSET_CUDA_VISIBLE_DEVICES", "1")  # else Ray hides them
    import ray

    given = address()
    quiet = {"log_to_driver": False, "logging_level": logging.ERROR}
    if given:
        try:
            ray.init(address=given, **quiet)
        # with another token than the cluster's, Ray raises an error of its own
        except (ConnectionError, RuntimeError, ValueError, ray.exceptions.RayError) as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise NeecoError(f"RAY_ADDRESS: {given} is no cluster that can be joined: {reason}") from None
    else:
        _start_here(ray, cores, quiet)
    try:
        yield ray
    finally:
        ray.shutdown()


def cpu_share(nodes: Sequence[Mapping[str, Any]], workers: int) -> int:
    """CPUs of each of so many workers: the largest share of which the nodes (`ray.nodes()`) have enough for all at
    once, at least 1."""
    counts = [int(node["Resources"].get("CPU", 0)) for node in nodes if node["Alive"]]
    shares = range(max(counts, default=1), 1, -1)
    return next((share for share in shares if sum(count // share for count in counts) >= workers), 1)


def require_shared(ray: Any, file: Path, inputs: Collection[Path]) -> None:
    """Raise NeecoError naming the first node with CPUs that does not see or cannot write to the folder of `file`, which
    is written there for the purpose, or does not see one of `inputs`. All paths are absolute."""
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    token = secrets.token_hex(8)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(token, encoding="utf-8")
        probes = {}
        for node in ray.nodes():
            if node["Alive"] and node["Resources"].get("CPU", 0) >= 1:
                there = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
                probe = ray.remote(num_cpus=0, max_retries=0, scheduling_strategy=there)(_probe)
                name = f"{node['NodeManagerHostname']} ({node['NodeManagerAddress']})"
                probes[probe.remote(file, token, tuple(inputs))] = name
        answered, silent = ray.wait(list(probes), num_returns=len(probes), timeout=PROBE_S)
        for probe in answered:
            try:
                problem = ray.get(probe)
            except ray.exceptions.RayError as error:  # neeco is not installed there, or is of another version
                problem = f"cannot run neeco: {str(getattr(error, 'cause', error)).strip().splitlines()[0]}"
            if problem:
                raise NeecoError(f"RAY_ADDRESS: node {probes[probe]} {problem}")
        if silent:
            raise NeecoError(f"RAY_ADDRESS: node {probes[silent[0]]} does not answer within {PROBE_S:.0f} s; remove it")
    finally:
        file.unlink(missing_ok=True)


def _probe(file: Path, token: str, inputs: tuple[Path, ...]) -> str | None:
    """On a node: what it lacks, in words; None: nothing."""
    remedy = "mount it there under the same path"
    if not file.is_file() or file.read_text(encoding="utf-8") != token:
        return f"does not see {file.parent} as this machine has it; {remedy}"
    if missing := next((path for path in inputs if not path.exists()), None):
        return f"does not see {missing}; {remedy}"
    if not os.access(file.parent, os.W_OK):
        return f"may not write to {file.parent}; allow it"
    return None


def _start_here(ray: Any, cores: int, quiet: dict[str, Any]) -> None:
    """Start Ray so that it listens on loopback alone: whoever reaches its ports can run programs."""
    from ray._private import ray_constants

    # where a machine may join a cluster, Ray takes its address in the network for 127.0.0.1, and listens on all
    before = ray_constants.ENABLE_RAY_CLUSTER
    ray_constants.ENABLE_RAY_CLUSTER = False
    try:
        ray.init(num_cpus=cores, include_dashboard=False, _node_ip_address="127.0.0.1", **quiet)
    finally:
        ray_constants.ENABLE_RAY_CLUSTER = before
    if any(node["NodeManagerAddress"] != "127.0.0.1" for node in ray.nodes()):
        ray.shutdown()
        raise NeecoError(f"--workers: Ray {ray.__version__} listens to the network, too; install neeco[cluster] again")
