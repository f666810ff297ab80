"""What became of scenes by others: the sentence of the README and the table of all pairs, from stored rows."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from benchmarks.survey import COMPUTED, REFUSED, TOLERANCE, UNDECIDED, WARNED, WRONG
from benchmarks.tables import markdown

Row = dict[str, Any]
SILENT = (COMPUTED, UNDECIDED, WRONG)  # computed without a warning
MEDIUM = "participating medium"  # what refusals say of them
LONGEST = 160  # characters of a reason in the table


def scene_of(row: Row) -> str:
    return row["case"].rpartition(": ")[0]


def sentence(rows: list[Row]) -> str:
    """How many pairs are computed, and what differences say of them."""
    words = Counter(row["word"] for row in rows)
    refused = [row for row in rows if row["word"] == REFUSED]
    media = sum(MEDIUM in row["reason"] for row in refused)
    checked = [row for row in rows if row["word"] in SILENT] or rows
    silent, seconds = sum(words[word] for word in SILENT), [row["settings"]["seconds"] for row in checked]
    limits = " to ".join(f"{s:g}" for s in sorted({min(seconds), max(seconds)}))
    folders = " and ".join(sorted({scene_of(row).partition("/")[0] for row in rows}))
    other = {word: count for word, count in words.items() if word not in (*SILENT, WARNED, REFUSED)}
    more = "".join(f", {count} {word}" for word, count in other.items())
    return (
        f"**Scenes by others.** Of {len(rows)} pairs of a scene and something in it that moves ({folders}, "
        f"{len({scene_of(row) for row in rows})} scenes), {silent} are computed without a warning, {words[WARNED]} "
        f"with one, {len(refused)} are refused ({media} for participating media){more}. In checks of {limits} s, "
        f"finite differences confirm {words[COMPUTED]} of the {silent} to {100 * TOLERANCE:.0f} % and contradict "
        f"{words[WRONG] or 'none'}; for {words[UNDECIDED]} that is too short."
    )


def undecided_words(rows: list[Row]) -> str:
    """How far off the gains of undecided pairs are, in their own standard errors."""
    z = [(row["gain"] - 1) / row["stderr"] for row in rows if row["word"] == UNDECIDED and row["stderr"]]
    if not z:
        return ""
    return (
        f"Gains of undecided pairs are off by {np.sqrt(np.mean(np.square(z))):.2f} of their own standard errors (root "
        f"mean square of {len(z)}; {np.abs(z).max():.1f} at most). Errors measured from few seeds are rough ones."
    )


def table(rows: list[Row]) -> str:
    lines = []
    for row in rows:
        scene, _, param = row["case"].rpartition(": ")
        known = row["gain"] is not None and row["stderr"] is not None
        gain = f"{row['gain']:.3f} +- {row['stderr']:.3f}" if known else ""
        reason = row["reason"].partition("\n")[0].replace("|", "\\|")
        lines.append([scene, param, row["word"], gain, reason[:LONGEST]])
    return markdown(("scene", "what moves", "result", "gain", "reason"), lines)
