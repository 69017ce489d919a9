"""`suite sweep --engine ray` on a cluster of two nodes, of which one is lost."""

from __future__ import annotations

from pathlib import Path

import pytest

from suite.runs.sweep import log_of
from tests.runs.sweeping import GRID, finish, finished, just_begun, owner, parent, records, snapshot, sweeping, until

# JAX fears for forks of its process; Ray's become other programs at once.
pytestmark = [
    pytest.mark.usefixtures("elsewhere"),
    pytest.mark.filterwarnings(r"ignore:os\.fork\(\) was called:RuntimeWarning"),
]


@pytest.fixture
def cluster():
    """Ray with two nodes of one CPU each, on this machine."""
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    sizes = {"num_cpus": 1, "object_store_memory": 80 * 2**20}
    cluster = Cluster(initialize_head=True, head_node_args={**sizes, "include_dashboard": False})
    cluster.add_node(**sizes)
    yield cluster
    cluster.shutdown()


def test_a_cluster_that_loses_a_node_in_the_middle(cluster):
    (node,) = cluster.worker_nodes
    raylet = node.all_processes["raylet"][0].process.pid

    def on_node(folder):
        pid = owner(folder)
        while pid and pid != raylet:
            pid = parent(pid)
        return pid == raylet

    with sweeping(*GRID, "--seeds", "0-2", "--engine", "ray", "--address", cluster.address) as driver:
        (cut_off, *_) = until(lambda: finished() and list(filter(on_node, just_begun())), driver)
        files = snapshot(finished())
        cluster.remove_node(node, allow_graceful=False)
        code, runs = finish(driver)
    assert code == 0, Path("stdout").read_text()
    assert {run["status"] for run in runs.values()} == {"finished"}
    assert {folder.resolve() for folder in finished()} == runs.keys() and len(runs) == 6
    assert files and snapshot(path.parent for path in files if path.name == "record.json") == files
    assert len(records()[cut_off]["resumed"]) == 1
    said = Path("stderr").read_text().splitlines()
    others = [line for line in said if not line.startswith("[")]  # of statuses: "[1/6] ..."
    assert [line.partition(" the node ")[0] for line in others] == ["Ray lost"] * len(others) and len(others) <= 1, (
        others
    )
    assert log_of(cut_off).read_text().count(": suite run ") == 2
