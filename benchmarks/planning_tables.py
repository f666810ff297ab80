"""Rows of the suite `planning` as Markdown, and the figures that its charts draw."""

from __future__ import annotations

from typing import Any

from benchmarks.planning import AUTO, EQUAL_BUDGETS, MATERIAL, OFF, ON, OURS, PRB, SPATIAL
from benchmarks.tables import Row, geometric_mean, markdown

NEAR = 1.1  # times the cost of the better form that counts as chosen well


def by_case(rows: list[Row], family: str) -> dict[str, dict[str, Row]]:
    """Case without its family -> method -> row."""
    found: dict[str, dict[str, Row]] = {}
    for row in rows:
        if row["case"].startswith(f"{family}: ") and row["status"] == "ok":
            found.setdefault(row["case"].split(": ", 1)[1], {})[row["method"]] = row
    return found


def plan_table(rows: list[Row]) -> str:
    """What a lean plan saves; the difference of its derivative in standard errors."""
    lines = []
    for case, r in by_case(rows, "plan").items():
        if {ON, OFF} <= set(r):
            on, off = r[ON], r[OFF]
            ratio = off["time_ratio"]["median"]
            variance = f"{off['variance'] / on['variance']:.3g}" if on["variance"] > 0 else "-"
            lines.append([case, ", ".join(on["plan"]["spp"]) or "nothing", f"{on['seconds']['median'] * 1e3:.1f}",
                          f"{off['seconds']['median'] * 1e3:.1f}", f"{ratio:.2f}", variance,
                          f"{off['rms_z']:.2f}", f"{off['max_z']:.1f}"])  # fmt: skip
    head = ("differentiated", "terms that run", "ms, lean plan", "ms, full plan", "times faster", "times less variance",
            "RMS z of the difference", "largest z")  # fmt: skip
    return markdown(head, lines)


def forms(rows: list[Row]) -> list[dict[str, Any]]:
    """Costs (variance × seconds) of both forms, of `auto` and of equal budgets, per scene."""
    found = []
    for case, r in by_case(rows, "scene").items():
        if {EQUAL_BUDGETS, SPATIAL, MATERIAL, AUTO} <= set(r) and all(r[m]["cost"] > 0 for m in (SPATIAL, MATERIAL)):
            better = min(r[SPATIAL]["cost"], r[MATERIAL]["cost"])
            found.append({"case": case, "rows": r, "better": better, "auto": r[AUTO]["cost"] / better,
                          "budgets": r[EQUAL_BUDGETS]["cost"] / r[SPATIAL]["cost"]})  # fmt: skip
    return found


def forms_table(rows: list[Row]) -> str:
    lines = []
    for f in forms(rows):
        r = f["rows"]
        lines.append([f["case"], *(f"{r[m]['cost']:.2e}" for m in (SPATIAL, MATERIAL, AUTO)), r[AUTO]["plan"]["form"],
                      f"{f['auto']:.2f}", f"{f['budgets']:.2f}", f"{r[MATERIAL]['rms_z']:.2f}",
                      f"{r[MATERIAL]['max_z']:.1f}"])  # fmt: skip
    head = ("scene", "spatial", "material", "auto", "chosen", "auto / better form", "equal / automatic budgets",
            "RMS z, material against spatial", "largest z")  # fmt: skip
    return markdown(head, lines)


def forms_words(rows: list[Row]) -> str:
    found = forms(rows)
    if not found:
        return ""
    well = sum(f["auto"] <= NEAR for f in found)
    return (
        f"`auto` is within 10 % of the better form in {well} of {len(found)} scenes (variance x seconds, paths of four "
        f"segments). Budgets by measured noise are {geometric_mean(f['budgets'] for f in found):.2f} times better than "
        f"equal ones in the geometric mean ({min(f['budgets'] for f in found):.2f} at worst, "
        f"{max(f['budgets'] for f in found):.2f} at best)."
    )


def prb_table(rows: list[Row]) -> str:
    lines = []
    for case, r in by_case(rows, "prb").items():
        if {OURS, PRB} <= set(r):
            ours, prb = r[OURS], r[PRB]
            lines.append([case, f"{ours['seconds']['median'] * 1e3:.1f}", f"{prb['seconds']['median'] * 1e3:.1f}",
                          f"{ours['variance']:.2e}", f"{prb['variance']:.2e}", f"{ours['cost'] / prb['cost']:.2g}"])
    head = ("parameter", "ms", "ms, prb", "variance", "variance, prb", "time at equal variance relative to prb")
    return markdown(head, lines)
