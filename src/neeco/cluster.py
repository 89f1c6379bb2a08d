"""Ray: on this machine, or the cluster that RAY_ADDRESS names."""

from __future__ import annotations

import importlib.util
import logging
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from neeco.errors import NeecoError

CONNECT = 5.0  # s that a cluster's head gets to answer


def address() -> str | None:
    """Of the cluster to work on; None: this machine."""
    return os.environ.get("RAY_ADDRESS") or None


def require_ray() -> None:
    """Raises NeecoError when Ray is not installed, or nobody listens at the HOST:PORT that RAY_ADDRESS names."""
    if importlib.util.find_spec("ray") is None:
        raise NeecoError("--workers: several at once need Ray; install neeco[cluster], or leave --workers out")
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
        except (ConnectionError, RuntimeError, ValueError) as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise NeecoError(f"RAY_ADDRESS: {given} is no cluster that can be joined: {reason}") from None
    else:
        _start_here(ray, cores, quiet)
    try:
        yield ray
    finally:
        ray.shutdown()


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
