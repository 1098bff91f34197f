"""Write `report.html`: one file about one run, which needs no network and no other file."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from scanweld.arrays import Int64
from scanweld.config import to_toml
from scanweld.evaluation.trajectory_metrics import AteResult
from scanweld.geometry import se3
from scanweld.io.atomic import write_file
from scanweld.report.assembly import make_document
from scanweld.report.charts import Chart, accuracy_charts, evaluate, tracking_charts
from scanweld.report.run_files import RunFiles, poses_of_frames, read_run_files
from scanweld.report.scene import display_frame, encode_scene, floats, select_points
from scanweld.report.settings import default_values, find_differences, marked_toml
from scanweld.report.stretches import KINDS, Stretch, find_stretches, kinds_of
from scanweld.report.verdict import Verdict, judge, other_warnings
from scanweld.report.words import count_of, length
from scanweld.slam.config import SlamConfig

REPORT_FILE = "report.html"

MAX_FRAMES = 20_000
"""Frames that the slider and the charts of a page hold; of a longer run every n-th is shown."""

MAX_ROWS = 60
"""Rows of the table of frames; of more stretches the longest are shown."""

MAX_TRUTH_POSES = 5_000

JPEG_QUALITY = 82

SCRIPTS = ("page.js", "charts.js", "viewer.js")

_KIND_LETTERS = {
    "": "t",
    "lost": "l",
    "unreadable": "u",
    "dropped": "s",
    "relocalised": "r",
    "degenerate": "d",
    "unfinished": "m",
    "elsewhere": "e",
}


def write_report(folder: Path, *, truth: Path | None = None, out: Path | None = None) -> Path:
    """Write the report of a run from the files in its folder, and return where it is.

    Parameters
    ----------
    folder : a run folder, of this or an earlier version
    truth : true trajectory to compare with, in place of the one that the run kept
    out : file to write; default report.html in the folder

    Raises
    ------
    FileFormatError
        When the folder is no run folder, or one of its files cannot be read.
    OutputError
        When the report cannot be written.
    """
    path = out or folder / REPORT_FILE
    write_file(path, make_page(read_run_files(folder, truth=truth)).encode("utf-8"))
    return path


def make_page(run: RunFiles) -> str:
    """Return the report of a run as one HTML page; every text of the run is escaped."""
    stride = -(-len(run.frames) // MAX_FRAMES)
    shown = np.arange(0, len(run.frames), stride)
    error = evaluate(run.trajectory, run.truth)
    verdict, stretches = judge(run.frames, run.metrics, run.run), find_stretches(run.frames)
    accuracy = accuracy_charts(run, error, shown) if error is not None else []
    tracking = tracking_charts(run.frames, shown, final_surfels=run.metrics.get("num_surfels"))
    scene, points = _scene(run, shown, error)
    data = {
        "frames": _frame_data(run, shown),
        "charts": {chart.key: chart.data() for chart in (*accuracy, *tracking)},
        "scene": scene,
    }
    return make_document(
        "report",
        {
            "data": _as_json(data),
            "points": points,
            "name": escape(run.name),
            "subtitle": escape(_subtitle(run)),
            "verdict": _verdict(verdict),
            "tiles": _tiles(run),
            "map_note": escape(_map_note(scene)),
            "canvas_label": escape(f"Map of {run.name} in 3-D with the path of the camera"),
            "last_frame": str(len(shown) - 1),
            "truth_hidden": "" if "truth" in scene else "hidden",
            "normals_hidden": "" if scene["hasNormals"] else "hidden",
            "loops_hidden": "" if len(run.keyframes) or len(run.loops) else "hidden",
            "stretches": _stretch_table(run, stretches),
            "accuracy": _accuracy(run, accuracy),
            "tracking": _charts(tracking),
            "renders": _renders(run.renders),
            "configuration": _configuration(run),
            "warnings": _warnings(run.run),
            "environment": _environment(run),
        },
        body="run.html",
        styles=["report.css"],
        scripts=SCRIPTS,
    )


def _as_json(data: Any) -> str:
    """Return JSON that may stand in a script element whatever texts it holds."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _frame_data(run: RunFiles, shown: Int64) -> dict[str, Any]:
    frames, kinds = run.frames, kinds_of(run.frames)
    texts = {"": 0}
    notes = [texts.setdefault(frames.note[i], len(texts)) for i in shown]
    return {
        "count": len(shown),
        "numbers": frames.number[shown].tolist(),
        "time": floats(frames.timestamp_s[shown] - frames.timestamp_s[0]),
        "kinds": "".join(_KIND_LETTERS[kinds[i]] for i in shown),
        "names": {letter: KINDS.get(kind, "TRACKING") for kind, letter in _KIND_LETTERS.items()},
        "notes": notes,
        "texts": list(texts),
    }


def _scene(run: RunFiles, shown: Int64, error: AteResult | None) -> tuple[dict[str, Any], str]:
    points = select_points(run.surfels)
    poses, known = poses_of_frames(run.frames, run.trajectory)
    posed = run.frames.posed
    slot = {int(run.frames.number[i]): k for k, i in enumerate(shown) if posed[i]}
    keyframes = [slot[int(k)] for k in run.keyframes if int(k) in slot]
    loops = [[slot[int(a)], slot[int(b)]] for a, b in run.loops if int(a) in slot and int(b) in slot]
    camera = run.run.get("intrinsics")
    usable = isinstance(camera, dict) and all(_positive(camera.get(key)) for key in ("width", "height", "fx", "fy"))
    scene, text = encode_scene(
        points, poses[shown], known[shown],
        camera={key: float(camera[key]) for key in ("width", "height", "fx", "fy")} if usable and camera else None,
        keyframes=np.array(keyframes, np.int64), loops=np.array(loops, np.int64).reshape(-1, 2),
    )  # fmt: skip
    if error is not None:
        rows = np.linspace(0, error.num_pairs - 1, min(error.num_pairs, MAX_TRUTH_POSES)).astype(int)
        T = display_frame(points.position_m, poses[shown]) @ se3.inverse(error.T_truth_estimate)
        scene["truth"] = floats(se3.transform_points(T, error.positions_truth_m[rows]))
    return scene, text


def _positive(value: Any) -> bool:
    return isinstance(value, (int, float)) and value > 0


def _subtitle(run: RunFiles) -> str:
    """Return what was run, in one line."""
    frames, times = run.frames, run.frames.timestamp_s
    parts = [count_of(len(frames), "frame")]
    if len(frames) > 1:
        parts.append(f"{times[-1] - times[0]:.1f} s")
    parts.append(f"{length(float(run.metrics.get('path_length_m') or 0))} of path")
    parts.append(f"scanweld {run.run.get('scanweld', 'of unknown version')}")
    return " · ".join(parts)


def _verdict(verdict: Verdict) -> str:
    mark = {"trustworthy": "✓", "doubtful": "!", "untrustworthy": "✕"}[verdict.level]
    reasons = "".join(f"<li>{escape(text)}</li>" for text in verdict.reasons)
    advice = "".join(f"<li>{escape(text)}</li>" for text in verdict.advice)
    return (
        f'<section class="verdict {verdict.level}" aria-labelledby="verdict">'
        f'<h2 id="verdict"><span class="mark" aria-hidden="true">{mark}</span>{escape(verdict.headline)}</h2>'
        f"<div><h3>Why</h3><ul>{reasons}</ul></div>"
        + (f"<div><h3>What to try</h3><ul>{advice}</ul></div>" if advice else "")
        + "</section>"
    )


def _tiles(run: RunFiles) -> str:
    """Return the figures that are asked for first."""
    m = run.metrics
    tracked, total = int(run.frames.posed.sum()), len(run.frames)
    dropped = run.frames.state.count("dropped")
    tiles = [("frames tracked", f"{tracked:,}", f"of {total:,}" + (f", {dropped:,} dropped" if dropped else ""))]
    if {"ate_rmse_m", "ate_max_m"} <= m.keys():
        tiles.append(("error of the path (ATE)", length(m["ate_rmse_m"]), f"at most {length(m['ate_max_m'])}"))
    if {"rpe_trans_m", "rpe_rot_deg"} <= m.keys():
        tiles.append(("error a frame (RPE)", length(m["rpe_trans_m"]), f"{m['rpe_rot_deg']:.3g}°"))
    kinds = kinds_of(run.frames)
    found, elsewhere = kinds.count("relocalised"), kinds.count("elsewhere")
    lost = kinds.count("lost") + elsewhere  # as metrics.json and the command line count them
    more = [f"found again {found}×"] * (found > 0) + [f"{elsewhere:,} of them in another submap"] * (elsewhere > 0)
    tiles.append(("frames lost", f"{lost:,}", ", ".join(more) if lost else "never"))
    tiles.append(("loops closed", f"{m.get('loop_closures', 0):,}", ""))
    input_points = m.get("num_points_input") or 0
    tiles.append(("surfels", f"{m.get('num_surfels', 0):,}", f"from {input_points / 1e6:,.1f} M points"))
    if m.get("fps"):
        tiles.append(("frames a second", f"{m['fps']:.1f}", f"{m.get('ms_per_frame_median') or 0:.0f} ms a frame"))
    if m.get("peak_rss_mb"):
        tiles.append(("memory, at most", f"{m['peak_rss_mb']:,.0f} MB", ""))
    return "".join(
        f"<div><dt>{escape(name)}</dt><dd>{escape(value)} <small>{escape(more)}</small></dd></div>"
        for name, value, more in tiles
    )


def _map_note(scene: Mapping[str, Any]) -> str:
    if scene["count"] == scene["total"]:
        return f"All {scene['total']:,} surfels of the map are shown."
    reasons = []
    if scene["leftOut"]:
        reasons.append(f"{scene['leftOut']:,} that were seen about once, mostly noise, are left out")
    if scene["spacing"] > 0:
        reasons.append(f"{'the others' if reasons else 'they'} are thinned evenly to one in {length(scene['spacing'])}")
    return f"{scene['count']:,} of {scene['total']:,} surfels are shown: {', '.join(reasons)}. map.ply has them all."


def _stretch_table(run: RunFiles, stretches: Sequence[Stretch]) -> str:
    if not stretches and not run.frames.aligned.any():
        return "<p>The poses were given: no frame was tracked.</p>"
    if not stretches:
        which = "frame that was not dropped" if "dropped" in run.frames.state else "frame"
        return f"<p>Every {which} was plainly tracked: aligned with the map, converged, and believed.</p>"
    shown = sorted(sorted(stretches, key=lambda s: -s.count)[:MAX_ROWS], key=lambda s: s.first)
    rows = "".join(_stretch_row(run, stretch) for stretch in shown)
    left_out = len(stretches) - len(shown)
    more = f"<p>{count_of(left_out, 'shorter stretch').replace('stretchs', 'stretches')} left out; " if left_out else ""
    return (
        '<div class="scroll" tabindex="0" role="region" aria-label="Table of frames that were not plainly tracked">'
        '<table><thead><tr><th scope="col">Frames</th><th scope="col">State</th><th scope="col">Why</th></tr></thead>'
        f"<tbody>{rows}</tbody></table></div>" + (f"{more}frames.csv has every frame.</p>" if more else "")
    )


def _stretch_row(run: RunFiles, stretch: Stretch) -> str:
    first, last = run.frames.number[stretch.first], run.frames.number[stretch.last]
    where = f"{first}" if first == last else f"{first}–{last}"
    reasons = [note + (f" ({count}×)" if len(stretch.reasons) > 1 else "") for note, count in stretch.reasons]
    told = "; ".join(reasons[:3]) + (f"; and {len(reasons) - 3} more" if len(reasons) > 3 else "")
    ending = f'<br><span class="ending">{escape(stretch.ending)}</span>' if stretch.ending else ""
    return (
        f'<tr><td><button type="button" class="go" data-frame="{first}">{where}</button>'
        f" <small>{count_of(stretch.count, 'frame')}</small></td>"
        f'<td><span class="state {stretch.kind}">{KINDS[stretch.kind]}</span></td><td>{escape(told)}{ending}</td></tr>'
    )


def _accuracy(run: RunFiles, charts: Sequence[Chart]) -> str:
    if charts:
        return _charts(charts)
    if run.truth is not None:
        return "<p>The true path has no poses at the times of this run: nothing can be compared.</p>"
    return (
        "<p>The sequence has no ground truth, or the run did not keep it: nothing to compare with. "
        "<code>scanweld report RUN --truth FILE</code> draws this part for a trajectory file.</p>"
    )


def _charts(charts: Iterable[Chart]) -> str:
    return '<div class="charts">' + "".join(_chart(chart) for chart in charts) + "</div>"


def _chart(chart: Chart) -> str:
    label = f"Chart: {chart.title}. {chart.summary}."
    kind = f"{chart.kind} wide" if chart.wide else chart.kind
    legend = ""
    if len(chart.series) > 1:
        names = "".join(
            f'<li><span class="swatch s{k + 1}"></span>{escape(s.name)}</li>' for k, s in enumerate(chart.series)
        )
        legend = f'<ul class="legend">{names}</ul>'
    unit = f' <span class="unit">[{escape(chart.unit)}]</span>' if chart.unit else ""
    return (
        f'<figure class="chart {kind}"><figcaption><h3>{escape(chart.title)}{unit}</h3>'
        f'<output class="readout"></output><p class="summary">{escape(chart.summary)}</p></figcaption>'
        f'<div class="plot" data-chart="{chart.key}" role="img" aria-label="{escape(label)}"></div>{legend}'
        f'<p class="about">{escape(chart.about)}</p></figure>'
    )


def _renders(paths: Sequence[Path]) -> str:
    """Return the pictures of the map, those of one place side by side."""
    ordered = sorted(paths, key=lambda path: (path.stem.rpartition("-")[0], path.stem.endswith("normals")))
    figures = [(path.stem, _as_jpeg(path)) for path in ordered]
    pictures = "".join(
        f'<figure><img src="{source}" width="{width}" height="{height}" decoding="async" '
        f'alt="{escape(_render_words(stem))}"><figcaption>{escape(_render_words(stem))}</figcaption></figure>'
        for stem, found in figures
        if found is not None
        for source, width, height in (found,)
    )
    return f'<div class="renders">{pictures}</div>' if pictures else "<p>The run folder has no pictures.</p>"


def _render_words(stem: str) -> str:
    place, _, kind = stem.rpartition("-")
    shares = {"view-1": "after a tenth of the path", "view-2": "half-way", "view-3": "after nine tenths of the path"}
    where = "from behind and above" if place == "overview" else shares.get(place, place)
    return f"The map {where}, {'in colour' if kind == 'rgb' else kind}"


def _as_jpeg(path: Path) -> tuple[str, int, int] | None:
    """Return a picture as a small data address with its width and height, None when it cannot be read."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        return None
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        return None
    source = "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode("ascii")
    return source, image.shape[1], image.shape[0]


def _configuration(run: RunFiles) -> str:
    if not run.config_text:
        return "<p>The run folder has no config.toml.</p>"
    differences = find_differences(run.config, default_values(to_toml(SlamConfig())))
    if differences:
        rows = "".join(
            f"<tr><td><code>{escape(d.key)}</code></td><td>{escape(_value(d.value))}</td>"
            f"<td>{escape('unknown to this version' if d.default is None else _value(d.default))}</td></tr>"
            for d in differences
        )
        what = (
            f"<p>{count_of(len(differences), 'setting')} differ{'s' if len(differences) == 1 else ''} from the "
            'defaults of this version:</p><div class="scroll" tabindex="0" role="region" aria-label="Changed settings">'
            "<table>"
            '<thead><tr><th scope="col">Setting</th><th scope="col">Here</th><th scope="col">Default</th></tr></thead>'
            f"<tbody>{rows}</tbody></table></div>"
        )
    else:
        what = "<p>Every setting has its default value.</p>"
    return (
        f"{what}<details><summary>config.toml, whole</summary>"
        f'<pre tabindex="0">{marked_toml(run.config_text, differences)}</pre></details>'
    )


def _warnings(run: Mapping[str, Any]) -> str:
    warnings = other_warnings(run)
    if not warnings:
        return ""
    items = "".join(f"<li>{escape(text)}</li>" for text in warnings[:MAX_ROWS])
    return f'<div class="warnings"><h3>Warnings</h3><ul>{items}</ul></div>'


def _environment(run: RunFiles) -> str:
    told = {"warnings", "packages", "intrinsics", "name", "fingerprint", "fragments"}
    rows = [(key, _value(value)) for key, value in run.run.items() if key not in told and value not in (None, [], "")]
    fragments = run.run.get("fragments")
    if fragments:
        rows.append(("made in fragments", _fragments(fragments)))
    packages = run.run.get("packages")
    if isinstance(packages, dict):
        rows += [(str(key), str(value)) for key, value in packages.items()]
    fingerprint = run.run.get("fingerprint")
    if isinstance(fingerprint, dict):
        rows.append(("checksum of the frames", str(fingerprint.get("content", ""))))
    camera = run.run.get("intrinsics")
    if isinstance(camera, dict):
        rows.append(("intrinsics", ", ".join(f"{key} {_value(value)}" for key, value in camera.items())))
    if run.metrics.get("seconds_total"):
        rows.append(("seconds in all", f"{run.metrics['seconds_total']:.1f}"))
    body = "".join(f'<tr><th scope="row">{escape(key)}</th><td>{escape(value)}</td></tr>' for key, value in rows)
    return f'<div class="scroll" tabindex="0" role="region" aria-label="Environment"><table>{body}</table></div>'


def _fragments(fragments: Any) -> str:
    """Return how many fragments a run was made in and what ties them; as it is where it is not what a run writes."""
    try:
        number = len(fragments["parts"])
        found, kept = (sum(link[key] for link in fragments["links"]) for key in ("edges", "kept"))
    except (KeyError, TypeError):
        return _value(fragments)
    return f"{number}, tied together by {kept:,} of {count_of(found, 'link')} between them"


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:g}"
    return value if isinstance(value, str) else json.dumps(value)
