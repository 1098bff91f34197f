"""What results show in a notebook: small cards without scripts, whose texts are escaped; and short reprs."""

from __future__ import annotations

import base64
import html.parser
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

import scanweld as sw
from scanweld.notebook import BAD, DOUBTFUL, GOOD, seen_from_above
from scanweld.registration.result import FreeDirection


class Card(html.parser.HTMLParser):
    """Collects the words of a card, and sees that its elements are harmless and closed in order."""

    def __init__(self, result: Any) -> None:
        super().__init__()
        self.words: list[str] = []
        self._open: list[str] = []
        self.feed(result._repr_html_())
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert tag in ("div", "span", "table", "tr", "td", "pre", "img")
        assert {name for name, _ in attrs} <= {"style", "aria-hidden", "src", "alt"}
        assert all((value or "").startswith("data:image/png;base64,") for name, value in attrs if name == "src")
        if tag != "img":
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def result_of(status: sw.Status, T_target_source: Any = None, **more: Any) -> sw.RegistrationResult:
    """A result that is made up."""
    T = np.eye(4) if T_target_source is None else np.array(T_target_source, np.float64)
    return sw.RegistrationResult(T_target_source=T, status=status, information=np.eye(6), **more)


def test_a_result_says_its_motion() -> None:
    """A quarter turn about z and a shift by (3, 4, 0): 5 m, 90 degrees."""
    T = [[0, -1, 0, 3], [1, 0, 0, 4], [0, 0, 1, 0], [0, 0, 0, 1]]
    result = result_of(sw.Status.CONVERGED, T, overlap=0.5, rmse_m=0.01, num_inliers=1234)
    assert repr(result) == "<RegistrationResult CONVERGED, 5 m, 90 deg, overlap 50%, rmse 0.01 m>"
    words = Card(result).words
    assert {"Registration: CONVERGED", "5 m, 90 deg", "50.0%, 1,234 pairs", "0.01 m"} <= {
        word.strip() for word in words
    }
    assert GOOD in result._repr_html_()


@pytest.mark.parametrize(("dimension", "words"), [(2, "0 m, 180 deg"), (3, "0 m, 180 deg"), (4, "0 m")])
def test_motions_of_any_dimension(dimension: int, words: str) -> None:
    """Half a turn in the first two axes; beyond space there is no single angle."""
    T = np.diag([-1.0, -1.0, *[1.0] * (dimension - 1)])
    assert words in Card(result_of(sw.Status.CONVERGED, T)).words


def test_a_result_without_an_answer_shows_no_matrix() -> None:
    result = result_of(sw.Status.NO_OVERLAP, note="only 3 % <of> the source & its partners")
    assert repr(result) == "<RegistrationResult NO_OVERLAP>"
    card = Card(result)
    assert "only 3 % <of> the source & its partners" in card.words
    assert "<pre" not in result._repr_html_()
    assert "motion" not in card.words
    assert BAD in result._repr_html_()


def test_free_directions_are_told_once() -> None:
    free = FreeDirection("translation along (1.00, 0.00, 0.00)", np.eye(6)[0])
    for note in ("", f"the data leaves free: {free.words}"):
        result = result_of(sw.Status.DEGENERATE, unobservable=(free,), note=note)
        assert " ".join(Card(result).words).count(free.words) == 1
        assert DOUBTFUL in result._repr_html_()


def a_map() -> sw.SurfelMap:
    """A floor of 2 m x 1 m at y = 0, red, under a green ceiling at y = -2 (y points down)."""
    x, z = (grid.ravel() for grid in np.meshgrid(np.linspace(0, 2, 60), np.linspace(0, 1, 30)))
    surfels = sw.SurfelMap()
    for y, normal, color in ((0.0, -1.0, (255, 0, 0)), (-2.0, 1.0, (0, 255, 0))):
        points = np.stack([x, np.full_like(x, y), z]).astype(np.float32)
        normals = np.zeros_like(points)
        normals[1] = normal
        colors = np.tile(np.array(color, np.float32)[:, None], len(x))
        surfels.append(points, normals, colors, np.full(len(x), 0.02, np.float32), np.ones(len(x), np.float32), 0)
    return surfels


def test_a_map_is_seen_from_above_without_its_ceiling() -> None:
    """The picture is as wide as the floor is long, and red: the ceiling faces away."""
    surfels = a_map()
    assert repr(surfels) == "<SurfelMap of 3,600 surfels>"
    assert {"Map of 3,600 surfels", "2.00 x 2.00 x 1.00 m", "20.0 mm (median)"} <= set(Card(surfels).words)
    match = re.search(r"base64,([^\"]+)", surfels._repr_html_())
    assert match is not None
    image = cv2.imdecode(np.frombuffer(base64.b64decode(match[1]), np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert image.shape == (100, 200, 4)
    seen = image[image[..., 3] > 0]
    assert len(seen) > 1000
    assert (seen == [0, 0, 255, 255]).all()  # OpenCV gives BGRA


def test_forward_is_up_in_the_picture() -> None:
    """A line along x = z, its first half red, its second half blue: red is left and below, blue right and above."""
    along = np.linspace(0, 1, 400)
    line = np.column_stack([along, np.zeros(400), along])
    colors = np.where(along[:, None] < 0.5, [[255, 0, 0]], [[0, 0, 255]])
    data = seen_from_above(line, np.tile([0, -1, 0], (400, 1)), colors)
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert image[-1, 0].tolist() == [0, 0, 255, 255]  # BGRA
    assert image[0, -1].tolist() == [255, 0, 0, 255]


def test_an_empty_map_has_a_card() -> None:
    assert Card(sw.SurfelMap()).words == ["Map of 0 surfels"]


def test_cards_are_small() -> None:
    """A notebook keeps them in its file."""
    assert len(a_map()._repr_html_()) < 60_000
    assert len(result_of(sw.Status.CONVERGED)._repr_html_()) < 4_000


@pytest.mark.parametrize(("lost", "mark"), [(0, GOOD), (3, DOUBTFUL), (40, BAD)])
def test_a_run_says_how_it_went(lost: int, mark: str) -> None:
    states = [sw.FrameState.TRACKING] * (60 - lost) + [sw.FrameState.LOST] * lost
    states[-1] = sw.FrameState.LOST if lost > 30 else sw.FrameState.RELOCALISED
    metrics = {
        "frames": 60, "frames_tracked": 60 - lost, "frames_lost": lost, "frames_unreadable": 0, "relocalisations": 1,
        "ate_rmse_m": 0.00125, "path_length_m": 1.5, "loop_closures": 0, "num_surfels": 3600,
    }  # fmt: skip
    results: Any = tuple(SimpleNamespace(state=state) for state in states)
    summary = sw.RunSummary(folder=Path("<run>"), metrics=metrics, results=results, map=a_map())
    assert repr(summary) == f"<RunSummary {60 - lost} of 60 frames tracked, 3,600 surfels>"
    assert mark in summary._repr_html_()
    words = Card(summary).words
    assert {"1.25 mm", "1.50 m", "<run>/", f" Run: {60 - lost} of 60 frames tracked"} <= set(words)
    assert ("lost" in words) == (lost > 0)
