"""Stored rows as Markdown. Computes ratios of stored numbers and nothing else."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

from benchmarks.suites import REFERENCE

OURS = "psdr_path"
#: A peer that finds less than half of the derivative, or more than one and a half times it, does not do the case.
DOES_IT = 0.5
RIGHT = 0.05  # |gain − 1| that counts as right in a sweep
ERRORS = 2.0  # standard errors that are granted on top
Row = dict[str, Any]


def markdown(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    rows = [head, ["---"] * len(head), *lines]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def geometric_mean(values: Iterable[float]) -> float:
    logs = [math.log(v) for v in values]
    return math.exp(sum(logs) / len(logs)) if logs else math.nan


def summary(rows: list[Row]) -> list[dict[str, Any]]:
    """For each case that a `prb_projective` configuration has figures for: ratios of the best of them to ours.

    The best in variance × seconds and the best in mean squared error after 10 s are chosen apart: the peer gets the
    better configuration of each figure. Where no configuration does the case (`DOES_IT`), variances do not compare:
    what a method leaves out it leaves out of its variance as well.
    """
    found = []
    for case in dict.fromkeys(row["case"] for row in rows):
        done = {row["method"]: row for row in rows if row["case"] == case and row.get("status") == "ok"}
        peers = [row for row in done.values() if row["family"] == "projective"]
        if OURS not in done or not peers:
            continue
        ours = done[OURS]
        able = [row for row in peers if abs(row["gain"] - 1) <= DOES_IT]
        cheapest = min(able or peers, key=lambda row: row["cost"])
        closest = min(peers, key=lambda row: row["error_10s"])
        found.append({
            "case": case, "does_it": bool(able), "ours": ours, "cheapest": cheapest, "closest": closest,
            "cost_ratio": cheapest["cost"] / ours["cost"],
            "mse_ratio": (closest["error_10s"] / ours["error_10s"]) ** 2,
        })  # fmt: skip
    return found


def gains_of_plans(forms: Iterable[dict[str, Any]]) -> list[tuple[str, list[float]]]:
    """What automatic budgets and forms win over equal budgets in the spatial form: `[(label, ratio per scene)]`."""
    found = list(forms)
    if not found:
        return []
    equal = [f["rows"]["spatial, equal budgets"]["cost"] for f in found]
    label = {"spatial": "automatic budgets", "material": "material form", "auto": "auto form and budgets"}
    return [(text, [e / f["rows"][name]["cost"] for e, f in zip(equal, found, strict=True)])
            for name, text in label.items()]  # fmt: skip


def summary_table(lines: list[dict[str, Any]]) -> str:
    def cells(line: dict[str, Any]) -> list[str]:
        ours, peer = line["ours"], line["closest"]
        cost = f"{line['cost_ratio']:.3g}" if line["does_it"] else f"({line['cost_ratio']:.3g})"
        return [
            line["case"], gain(ours), f"{ours['error_10s']:.2g}", gain(line["cheapest"]), f"{peer['error_10s']:.2g}",
            short(peer["method"]), cost, f"{line['mse_ratio']:.3g}",
        ]  # fmt: skip

    head = ("case", "gain", "error after 10 s", "gain of the peer", "its error after 10 s", "its configuration",
            "variance x seconds, ratio", "squared error after 10 s, ratio")  # fmt: skip
    return markdown(head, [cells(line) for line in lines])


def summary_words(lines: list[dict[str, Any]]) -> str:
    able = [line for line in lines if line["does_it"]]
    costs, errors = [line["cost_ratio"] for line in able], [line["mse_ratio"] for line in lines]
    if not able:
        return ""
    median = sorted(errors)[len(errors) // 2]
    return (
        f"Against the best configuration of `prb_projective` in each case: {geometric_mean(costs):.3g} times less "
        f"variance x seconds in the geometric mean of the {len(able)} cases of which it finds between half and one and "
        f"a half of the derivative ({min(costs):.3g} at least; the others are in brackets), and "
        f"{geometric_mean(errors):.3g} times less squared error after an equal 10 s in the mean of all {len(lines)} "
        f"cases (median {median:.3g}, {min(errors):.3g} at least)."
    )


def gain(row: Row) -> str:
    return f"{row['gain']:.3f} +- {row['gain_stderr']:.3f}"


def short(method: str) -> str:
    return method.removeprefix("prb_projective, ")


def accuracy_table(rows: list[Row]) -> str:
    """Every case and method."""
    lines = []
    for row in rows:
        if row["method"] == REFERENCE or "status" not in row:
            continue
        if row["status"] == "cannot":
            lines.append([row["case"], row["method"], f"cannot: {row['error']}", *[""] * 7])
            continue
        lines.append([
            row["case"], row["method"], gain(row), f"{row['error_10s']:.2e}", f"{math.sqrt(row['variance']):.2e}",
            bias(row), f"{row['seconds']['median']:.3f}", str(row["seeds"]), f"{row['cost']:.2e}",
            f"{row['floor']:.1e}",
        ])  # fmt: skip
    head = ("case", "method", "gain", "relative RMSE after 10 s", "standard deviation of a render", "bias",
            "seconds a render", "renders", "variance x seconds", "error of the reference")  # fmt: skip
    return markdown(head, lines)


def bias(row: Row) -> str:
    """Relative RMS bias, or the bound below which it is not seen."""
    value, error = row["bias2"], row["bias2_stderr"]
    if value > ERRORS * error:
        return f"{math.sqrt(value):.2e}"
    return f"< {math.sqrt(max(value, 0) + ERRORS * error):.1e}"


def reference_table(rows: list[Row], measured: list[Row]) -> str:
    """Provenance of the references, and what finite differences say of them."""
    lines = []
    for row in rows:
        differences = next((r for r in measured if r["case"] == row["case"] and r["method"] == "finite differences"
                            and r.get("status") == "ok"), None)  # fmt: skip
        lines.append([row["case"], f"{row['seeds']} x {row['settings']['spp']} spp", f"{row['rms']:.3g}",
                      f"{row['rms_stderr'] / row['rms']:.1e}" if row["rms"] else "",
                      gain(differences) if differences else ""])  # fmt: skip
    head = ("case", "seeds", "RMS of the derivative", "relative standard error", "gain of finite differences")
    return markdown(head, lines)


def sweep_words(row: Row) -> str:
    """Verdict on one step: gain, and what is wrong with it."""
    if row["status"] == "cannot":
        return "cannot"
    off = abs(row["gain"] - 1) > RIGHT + ERRORS * row["gain_stderr"]
    unsure = row["gain_stderr"] > RIGHT
    text = f"{row['gain']:.2f}" + (f"+-{row['gain_stderr']:.2f}" if unsure else "")
    bad = f", {row['not_finite']} not finite" if row["not_finite"] else ""
    return (f"**{text}**" if off else text) + bad


def stability_table(rows: list[Row]) -> str:
    """Gain per sweep, step and method; bold: off by more than 0.05 and two standard errors."""
    lines = []
    for name in dict.fromkeys(row["sweep"] for row in rows):
        steps = list(dict.fromkeys(row["value"] for row in rows if row["sweep"] == name))
        for method in dict.fromkeys(row["method"] for row in rows if row["sweep"] == name):
            mine = {row["value"]: row for row in rows if row["sweep"] == name and row["method"] == method}
            cells = [f"{step:g}: {sweep_words(mine[step])}" for step in steps if step in mine]
            lines.append([name, method, "; ".join(cells)])
    return markdown(("sweep", "method", "value: gain"), lines)


def stability_details(rows: list[Row]) -> str:
    lines = []
    for row in rows:
        start = [row["sweep"], f"{row['value']:g}", row["method"]]
        if row["status"] == "cannot":
            lines.append([*start, f"cannot: {row['error']}", *[""] * 5])
        else:
            lines.append([*start, gain(row), f"{row['error_10s']:.2e}", bias(row), str(row["not_finite"]),
                          f"{row['tail_share']:.2f}", f"{row['seconds']['median']:.3f}"])  # fmt: skip
    head = ("sweep", "value", "method", "gain", "relative RMSE after 10 s", "bias", "not finite", "heavy-tail index",
            "seconds a render")  # fmt: skip
    return markdown(head, lines)


def cost_table(rows: list[Row]) -> str:
    """Milliseconds in and outside of kernels, memory, and wall time relative to the primal of the same step."""
    lines = []
    for row in rows:
        start = [row["sweep"], f"{row['value']:g}", row["method"]]
        if row["status"] == "cannot":
            lines.append([*start, f"cannot: {row['error']}", *[""] * 4])
            continue
        beside = (r for r in rows if r["case"] == row["case"] and "primal" in r["method"] and "wall_ms" in r)
        primal = next(beside, None)
        ratio = f"{row['wall_ms']['median'] / primal['wall_ms']['median']:.2f}" if primal else ""
        lines.append([*start, f"{row['wall_ms']['median']:.1f}", f"{row['kernel_ms']['median']:.1f}",
                      f"{row['outside_kernels_ms']['median']:.1f}", f"{row['peak_mib']:.0f}", ratio])  # fmt: skip
    head = ("sweep", "value", "method", "wall [ms]", "kernels [ms]", "outside kernels [ms]", "peak memory [MiB]",
            "wall relative to `path`")  # fmt: skip
    return markdown(head, lines)
