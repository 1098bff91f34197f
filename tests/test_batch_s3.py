"""A run from and to an S3 server, where one for tests is installed (moto with its server, s3fs)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from scanweld.cluster.outcome import State
from scanweld.cluster.plan import plan_batch
from scanweld.cluster.task import run_task
from scanweld.datasets.synthetic import RenderConfig, render_sequence
from scanweld.errors import DatasetError
from scanweld.runs.input import RunInput
from scanweld.runs.storage.recordings import list_files
from scanweld.runs.storage.urls import write_to
from scanweld.slam.config import SlamConfig

pytest.importorskip("s3fs")
server = pytest.importorskip("moto.server")

pytestmark = pytest.mark.filterwarnings("ignore")  # those of the server and of the client are not ours


@pytest.fixture
def lab(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A bucket "lab", and a file system that reaches it."""
    import fsspec

    running = server.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    running.start()
    host, port = running.get_host_and_port()
    for name, value in (
        ("AWS_ENDPOINT_URL", f"http://{host}:{port}"), ("AWS_ACCESS_KEY_ID", "test"), ("AWS_SECRET_ACCESS_KEY", "test"),
        ("AWS_DEFAULT_REGION", "us-east-1"),
    ):  # fmt: skip
        monkeypatch.setenv(name, value)
    files = fsspec.filesystem("s3", skip_instance_cache=True)
    files.makedirs("lab", exist_ok=True)
    yield files
    running.stop()


def test_a_run_between_buckets(lab: Any, tmp_path: Path) -> None:
    render_sequence(tmp_path / "desk", RenderConfig(noise="none", frames=4, width=160, height=120))
    lab.put(str(tmp_path / "desk"), "lab/recordings/desk", recursive=True)
    (task,) = plan_batch(["s3://lab/recordings/desk"], "s3://lab/runs", RunInput(""), lambda _: SlamConfig())
    first, second = run_task(task, "b"), run_task(task, "b")
    assert (first.state, second.state) == (State.DONE, State.KEPT), first.reason
    names = list_files("s3://lab/runs/desk").sizes
    assert {"run.json", "metrics.json", "trajectory.txt", "renders/overview-rgb.png"} <= set(names)
    write_to("s3://lab/runs/report.html", b"<p>")
    assert lab.cat("lab/runs/report.html") == b"<p>"


def test_what_a_bucket_does_not_have(lab: Any) -> None:
    with pytest.raises(DatasetError, match=r"s3://lab/nothing: no such"):
        list_files("s3://lab/nothing")
