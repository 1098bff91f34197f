"""The page about a batch: its runs side by side, and what the settings that were swept do to them."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from typing import Any
from urllib.parse import quote

from scanweld.report.assembly import make_document
from scanweld.report.verdict import DOUBTFUL, HEADLINES, TRUSTWORTHY, UNTRUSTWORTHY
from scanweld.report.words import count_of, length

MAX_MAPS = 48
"""Pictures of maps on a page."""

MAX_FAULTS, MAX_NAMES = 8, 3
"""Faults that are told at the top of a page, and runs that are named with each; the table has them all."""

SHADES = (1.001, 1.1, 1.5, 3.0)
"""From which ratio to the best of its sequence on an error has the next shade."""

Row = Mapping[str, Any]


def make_batch_page(name: str, rows: Sequence[Row], swept: Sequence[str], seconds: float) -> str:
    """Return the page about a batch; every text of the runs is escaped.

    Parameters
    ----------
    name : of the batch
    rows : one a run: "run" (its folder within that of the batch), "input", "state", "verdict", "reason", metrics where
        it has them, and the values of what was swept
    swept : names of the settings that differ between runs
    seconds : that the batch took
    """
    pictured = [row for row in rows if row["verdict"]]
    return make_document(
        "batch",
        {
            "name": escape(name),
            "subtitle": escape(_subtitle(rows, swept)),
            "verdict": _verdict(rows),
            "tiles": _tiles(rows, seconds),
            "settings": _settings(rows, swept) if swept else "",
            "settings_hidden": "" if swept else "hidden",
            "runs": _runs(rows),
            "maps": _maps(pictured),
            "maps_hidden": "" if pictured else "hidden",
        },
        body="batch.html",
        styles=["report.css", "batch.css"],
        scripts=["batch.js"],
        images="'self' file:",
    )


def _subtitle(rows: Sequence[Row], swept: Sequence[str]) -> str:
    sequences = len({row["input"] for row in rows})
    versions = sorted({row["scanweld"] for row in rows if row.get("scanweld")})
    parts = [count_of(sequences, "sequence"), count_of(len(rows), "run")]
    parts += [f"{', '.join(swept)} swept"] if swept else []
    return " · ".join([*parts, *(f"scanweld {version}" for version in versions)])


def _good(row: Row) -> bool:
    return row["verdict"] in (TRUSTWORTHY, DOUBTFUL)


def _interrupted(row: Row) -> bool:
    return bool(row["state"] == "interrupted")


def _verdict(rows: Sequence[Row]) -> str:
    """Say how many runs can be trusted, and name those that cannot; one that was interrupted is neither."""
    ended = [row for row in rows if not _interrupted(row)]
    bad = [row for row in ended if not _good(row)]
    stopped = len(ended) < len(rows)
    level = TRUSTWORTHY if not (bad or stopped) else UNTRUSTWORTHY if len(bad) == len(rows) else DOUBTFUL
    mark = {TRUSTWORTHY: "✓", DOUBTFUL: "!", UNTRUSTWORTHY: "✕"}[level]
    goes_on = "<p>The same command goes on from here.</p>" if stopped else ""
    faults: dict[str, list[str]] = {}
    for row in bad:
        faults.setdefault(_reason(row), []).append(str(row["run"]))
    told = "".join(
        f"<li><strong>{', '.join(map(_name, runs[:MAX_NAMES]))}"
        f"{f' and {len(runs) - MAX_NAMES} more' if len(runs) > MAX_NAMES else ''}</strong>: {escape(fault)}</li>"
        for fault, runs in list(faults.items())[:MAX_FAULTS]
    )
    more = f"<p>and {len(faults) - MAX_FAULTS} other reasons: see the table</p>" if len(faults) > MAX_FAULTS else ""
    return (
        f'<section class="verdict {level}" aria-labelledby="verdict">'
        f'<h2 id="verdict"><span class="mark" aria-hidden="true">{mark}</span>'
        f"{_headline(len(rows), len(ended), len(ended) - len(bad))}</h2>"
        + (f"<div>{goes_on}{f'<ul>{told}</ul>' if told else ''}{more}</div>" if goes_on or told else "")
        + "</section>"
    )


def _headline(runs: int, ended: int, good: int) -> str:
    """Say how many of the runs ended, where not all did, and how many of these can be trusted."""
    if ended == 0:
        return f"Interrupted before {'the run' if runs == 1 else f'any of {runs} runs'} ended"
    if ended < runs:
        return f"Interrupted: {ended} of {runs} runs ended, {good or 'none'} of them can be trusted"
    if runs == 1:
        return f"The run {'can' if good else 'cannot'} be trusted"
    return f"{'All' if good == runs else good or 'None'} of {runs} runs can be trusted"


def _name(name: object) -> str:
    """Return the name of a run as HTML that may be broken between its parts."""
    return escape(str(name)).replace("/", "/<wbr>").replace(",", ",<wbr>").replace("=", "=<wbr>")


def _reason(row: Row) -> str:
    """Return why a run failed, without the name of the sequence: the same fault of another reads the same."""
    reason = str(row["reason"] or row["state"])
    places = (str(row["input"]), str(row["run"]).partition("/")[0])
    return next((reason.removeprefix(f"{place}: ") for place in places if reason.startswith(f"{place}: ")), reason)


def _tiles(rows: Sequence[Row], seconds: float) -> str:
    errors = [row["ate_rmse_m"] for row in rows if _number(row, "ate_rmse_m") is not None]
    frames, tracked = (sum(row.get(key) or 0 for row in rows) for key in ("frames", "frames_tracked"))
    clear = sum(row["verdict"] == TRUSTWORTHY for row in rows)
    kept = sum(row["state"] == "kept" for row in rows)
    computed = sum(row.get("seconds") or 0.0 for row in rows if row["state"] == "done")
    tiles = [("without reservations", f"{clear:,}", f"of {len(rows):,} runs")]
    if errors:
        tiles.append(("error of the path, median", length(statistics.median(errors)), f"at most {length(max(errors))}"))
    tiles.append(("frames tracked", f"{tracked:,}", f"of {frames:,}"))
    tiles.append(("time", _duration(seconds), f"{_duration(computed)} of work" if computed else ""))
    if kept:
        tiles.append(("finished before", f"{kept:,}", "not run again"))
    return "".join(
        f"<div><dt>{escape(name)}</dt><dd>{escape(value)} <small>{escape(more)}</small></dd></div>"
        for name, value, more in tiles
    )


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def _number(row: Row, key: str) -> float | None:
    value = row.get(key)
    return value if isinstance(value, (int, float)) else None


def _setting(row: Row, swept: Sequence[str]) -> tuple[str, ...]:
    return tuple(f"{row[key]:g}" if isinstance(row[key], float) else str(row[key]) for key in swept)


def _settings(rows: Sequence[Row], swept: Sequence[str]) -> str:
    """Return what each combination of settings comes to over all sequences, and by sequence."""
    groups: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(_setting(row, swept), []).append(row)
    heads = "".join(f'<th scope="col">{escape(key)}</th>' for key in swept)
    body = "".join(_setting_row(values, group) for values, group in groups.items())
    overall = (
        '<div class="scroll" tabindex="0" role="region" aria-label="Settings over all sequences"><table><thead><tr>'
        f'{heads}<th scope="col" class="n">can be trusted</th><th scope="col" class="n">error, median</th>'
        '<th scope="col" class="n">error, worst</th><th scope="col" class="n">frames a second, median</th></tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )
    if not any(_number(row, "ate_rmse_m") is not None for row in rows):
        return overall
    return overall + _matrix(rows, swept, list(groups))


def _setting_row(values: tuple[str, ...], group: Sequence[Row]) -> str:
    errors = [e for row in group if (e := _number(row, "ate_rmse_m")) is not None]
    speeds = [f for row in group if (f := _number(row, "fps")) is not None]
    figures = [
        f"{sum(map(_good, group))} of {len(group)}",
        length(statistics.median(errors)) if errors else "–",
        length(max(errors)) if errors else "–",
        f"{statistics.median(speeds):.1f}" if speeds else "–",
    ]
    cells = "".join(f"<td><code>{escape(value)}</code></td>" for value in values)
    return f"<tr>{cells}{''.join(f'<td class=n>{escape(figure)}</td>' for figure in figures)}</tr>"


def _matrix(rows: Sequence[Row], swept: Sequence[str], settings: Sequence[tuple[str, ...]]) -> str:
    """Return the error of each sequence with each setting, shaded by how far it is from the best of the sequence."""
    by_sequence: dict[str, dict[tuple[str, ...], Row]] = {}
    for row in rows:
        by_sequence.setdefault(str(row["run"]).rpartition("/")[0], {})[_setting(row, swept)] = row
    heads = "".join(f'<th scope="col">{escape(", ".join(values))}</th>' for values in settings)
    body = "".join(
        f'<tr><th scope="row">{escape(name)}</th>{"".join(_matrix_cells(found, settings))}</tr>'
        for name, found in by_sequence.items()
    )
    about = f"Error of the path (ATE) by {', '.join(swept)}; the best of each sequence is bold."
    return (
        '<h3 class="part">By sequence</h3>'
        f'<p class="about">{escape(about)}</p>'
        '<div class="scroll" tabindex="0" role="region" aria-label="Error by sequence and setting">'
        f'<table class="matrix"><thead><tr><th scope="col">Sequence</th>{heads}</tr></thead><tbody>{body}</tbody>'
        "</table></div>"
    )


def _matrix_cells(found: Mapping[tuple[str, ...], Row], settings: Sequence[tuple[str, ...]]) -> Iterator[str]:
    errors = [_number(found[s], "ate_rmse_m") if s in found and _good(found[s]) else None for s in settings]
    best = min((error for error in errors if error is not None), default=0.0)
    for setting, error in zip(settings, errors, strict=True):
        if error is None and setting in found and _interrupted(found[setting]):
            yield "<td>–</td>"
        elif error is None:
            yield '<td class="x">✕</td>'
        else:
            shade = sum(error > ratio * best for ratio in SHADES)
            yield f'<td class="q{shade}">{escape(length(error))}</td>'


def _runs(rows: Sequence[Row]) -> str:
    errors = [error for row in rows if (error := _number(row, "ate_rmse_m"))]
    ends = (min(errors) / 2, max(errors)) if errors else None
    heads = [("Run", ""), ("Verdict", "")]
    heads += [("ATE", "n"), ("", "bar")] if ends else []
    heads += [("Tracked", "n"), ("Loops", "n"), ("Frames/s", "n"), ("Time", "n")]
    head = "".join(
        f'<th scope="col" class="{kind}">{f"<button type=button>{escape(text)}</button>" if text else ""}</th>'
        for text, kind in heads
    )
    body = "".join(_run_row(row, ends) for row in rows)
    about = f"Bars are logarithmic, from {length(ends[0])} to {length(ends[1])}." if ends else ""
    return (
        '<div class="scroll" tabindex="0" role="region" aria-label="Table of runs">'
        f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
        f'<p class="about">{escape(about)}</p>'
    )


def _run_row(row: Row, ends: tuple[float, float] | None) -> str:
    """Return the row of a run; `ends` are those of the bars of errors [m]."""
    name, verdict, state = str(row["run"]), str(row["verdict"]), str(row["state"])
    sequence, _, settings = name.partition("/")
    link = f'<a href="{quote(name)}/report.html">{_name(sequence)}</a>' if verdict else _name(sequence)
    link += f'<span class="why">{_name(settings)}</span>' if settings else ""
    word = HEADLINES.get(verdict, state.capitalize())
    why = f'<span class="why">{escape(_reason(row))}</span>' if verdict != TRUSTWORTHY and row["reason"] else ""
    kept = ' <small title="It was finished before, and was not run again">kept</small>' if state == "kept" else ""
    rank = {TRUSTWORTHY: 0, DOUBTFUL: 1, UNTRUSTWORTHY: 2}.get(verdict, 3)
    cells = [
        f'<td class="run" data-v="{escape(name)}">{link}{kept}</td>',
        f'<td data-v="{rank}"><span class="chip {verdict or state}">{escape(word)}</span>{why}</td>',
    ]
    error = _number(row, "ate_rmse_m")
    if ends is not None:
        share = 100 * math.log(error / ends[0]) / math.log(ends[1] / ends[0]) if error else 0.0
        cells += [
            _figure(error, "" if error is None else length(error)),
            '<td class="bar"><svg viewBox="0 0 100 10" preserveAspectRatio="none" aria-hidden="true">'
            f'<rect class="{verdict}" width="{share:.1f}" height="10"/></svg></td>',
        ]
    tracked, frames = _number(row, "frames_tracked"), _number(row, "frames")
    cells.append(_figure(tracked, "" if tracked is None else f"{tracked:,.0f} of {frames:,.0f}"))
    for key, form in (("loop_closures", "{:.0f}"), ("fps", "{:.1f}"), ("seconds_total", "{:.0f} s")):
        value = _number(row, key)
        cells.append(_figure(value, "" if value is None else form.format(value)))
    return f"<tr>{''.join(cells)}</tr>"


def _figure(value: float | None, text: str) -> str:
    return f'<td class="n" data-v="{"" if value is None else value}">{escape(text)}</td>'


def _maps(rows: Sequence[Row]) -> str:
    """Return a picture of each map, from the run folders beside the page; doubtful ones first where there are many."""
    ranked = sorted(rows, key=lambda row: row["verdict"] == TRUSTWORTHY)[:MAX_MAPS] if len(rows) > MAX_MAPS else rows
    figures = "".join(
        f'<figure><a href="{quote(str(row["run"]))}/report.html"><img loading="lazy" decoding="async" '
        f'src="{quote(str(row["run"]))}/renders/overview-rgb.png" alt="{escape("The map of " + str(row["run"]))}">'
        f"<figcaption>{_name(row['run'])}</figcaption></a></figure>"
        for row in ranked
    )
    more = f"<p>{MAX_MAPS} of {len(rows)} maps, those in doubt first.</p>" if len(rows) > MAX_MAPS else ""
    return f'{more}<div class="renders">{figures}</div>'
