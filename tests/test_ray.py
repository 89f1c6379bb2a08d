"""On a cluster, nodes are asked before there is work for them; neeco starts no Ray of its own."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from neeco.base.errors import NeecoError
from neeco.base.workers import cpu_share, joined, node_problem, require_shared


@pytest.fixture
def cluster(environment) -> Iterator[Any]:
    """A head without CPUs and two nodes of one and two; RAY_ADDRESS names them."""
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    environment["RAY_USAGE_STATS_ENABLED"] = "0"
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    try:
        for count in (1, 2):
            made.add_node(num_cpus=count)
        made.wait_for_nodes()
        environment["RAY_ADDRESS"] = made.address
        yield made
    finally:
        made.shutdown()


@pytest.mark.slow
@pytest.mark.timeout(120)
def test_every_node_is_asked_whether_it_sees_the_folders(cluster: Any, tmp_path: Path) -> None:
    with joined() as ray:
        assert cpu_share(ray.nodes(), 2) == 1
        require_shared(ray, tmp_path / "new" / "out" / "probe", [tmp_path])
        with pytest.raises(NeecoError, match=r"RAY_ADDRESS: node \S+ \(\S+\) does not see \S+/away; mount it there"):
            require_shared(ray, tmp_path / "new" / "out" / "probe", [tmp_path / "away"])
    assert not any((tmp_path / "new" / "out").iterdir())


def test_a_node_that_has_another_folder_in_the_same_place_is_told_apart(tmp_path: Path) -> None:
    file = tmp_path / "probe"
    for content in (None, "another's"):
        if content is not None:
            file.write_text(content)
        assert f"does not see {tmp_path} as this machine has it" in str(node_problem(file, "ours", ()))
    file.write_text("ours")
    assert node_problem(file, "ours", (tmp_path,)) is None


@pytest.mark.parametrize(
    ("cpus", "workers", "share"),
    [((8,), 2, 4), ((4, 4), 3, 2), ((3, 3), 3, 1), ((2, 6), 2, 3), ((2, 6), 1, 6), ((2,), 5, 1), ((0, 4), 1, 4)],
)
def test_workers_share_the_cpus_of_the_nodes(cpus: tuple[int, ...], workers: int, share: int) -> None:
    nodes = [{"Alive": True, "Resources": {"CPU": float(count)}} for count in cpus]
    gone = {"Alive": False, "Resources": {"CPU": 64.0}}
    assert cpu_share([*nodes, gone, {"Alive": True, "Resources": {}}], workers) == share
