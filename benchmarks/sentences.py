"""What the charts of the README say, one sentence each. Counts and means of stored rows, nothing else."""

from __future__ import annotations

import math
from typing import Any

from benchmarks.tables import ERRORS, OURS, RIGHT, Row, geometric_mean, summary
from psdr_jit.derivative.verdict import NO_SIGNAL

PRIMAL = "path (primal)"
PEER_OF_SWEEPS = "prb_projective, no guiding"


def accuracy(rows: list[Row]) -> str:
    """Ours beside the best configuration of `prb_projective`, and who else is ahead where."""
    lines = summary(rows)
    able = [line["cost_ratio"] for line in lines if line["does_it"]]
    errors = sorted(line["mse_ratio"] for line in lines)
    if not able:
        return ""
    cases, ahead = _ahead(rows)
    beaten = "; ".join(f"{method} in {', '.join(f'*{name}*' for name in names)}" for method, names in ahead.items())
    rest = f" (ahead of it: {beaten})" if beaten else ""
    return (
        f"**Accuracy.** Next to the best configuration of Mitsuba's `prb_projective` in each case, `psdr_path` has "
        f"{number(geometric_mean(able))} times less variance x seconds ({len(able)} cases of which the peer finds "
        f"between half and one and a half of the derivative; geometric mean, {number(min(able))} at least), and "
        f"{number(errors[len(errors) // 2])} times less squared error, what the peer leaves out included, after an "
        f"equal 10 s ({len(errors)} cases; median, {number(errors[0])} at least). Of all methods it has the smallest "
        f"error after 10 s in {cases - sum(map(len, ahead.values()))} of {cases} cases{rest}."
    )


def number(value: float) -> str:
    """Two digits, without an exponent."""
    return f"{float(f'{value:.2g}'):,.10g}".replace(",", " ")


def _ahead(rows: list[Row]) -> tuple[int, dict[str, list[str]]]:
    """How many cases ours has figures for, and by method the cases in which another error after 10 s is smaller."""
    count, ahead = 0, {}
    for case in dict.fromkeys(row["case"] for row in rows):
        done = {row["method"]: row["error_10s"] for row in rows if row["case"] == case and row.get("status") == "ok"}
        if OURS not in done:
            continue
        count += 1
        best = min(done, key=lambda method: done[method])
        if best != OURS:
            ahead.setdefault(best, []).append(case)
    return count, ahead


def stability(rows: list[Row]) -> str:
    """In how many steps of the sweeps the gain is right."""

    def right(method: str) -> tuple[int, int, list[str]]:
        mine = [row for row in rows if row["method"] == method and row["status"] == "ok"]
        off = [row for row in mine if abs(row["gain"] - 1) > RIGHT + ERRORS * row["gain_stderr"]]
        return len(mine) - len(off), len(mine), [f"{row['sweep']} {row['value']:g}: {row['gain']:.2f}" for row in off]

    ours, steps, off = right(OURS)
    theirs, their_steps, _ = right(PEER_OF_SWEEPS)
    but = f" (not: {'; '.join(off)})" if off else ""
    return (
        f"**Stability.** Along sweeps towards where methods fail, the gain against finite differences (1 is right) is "
        f"off by no more than {RIGHT:g} and {ERRORS:g} standard errors in {ours} of {steps} steps{but}; that of "
        f"`prb_projective` in {theirs} of {their_steps}."
    )


def cost(rows: list[Row]) -> str:
    """Time of backward passes relative to the primal image, and the most memory that a call took."""
    done = [row for row in rows if row["status"] == "ok"]
    primal = {row["case"]: row["wall_ms"]["median"] for row in done if row["method"] == PRIMAL}
    shown = {"psdr_path": "psdr_path backward", "prb": "prb backward",
             "prb_projective": "prb_projective backward, no guiding"}  # fmt: skip
    means = {}
    for name, method in shown.items():
        ratios = [row["wall_ms"]["median"] / primal[row["case"]] for row in done
                  if row["method"] == method and row["case"] in primal]  # fmt: skip
        means[name] = geometric_mean(ratios)
    peers = ", ".join(f"`{name}` {mean:.1f}" for name, mean in means.items() if name != OURS and not math.isnan(mean))
    most = max((row["peak_mib"] for row in done if row["method"].startswith(OURS)), default=math.nan)
    return (
        f"**Cost.** With equal samples, a backward pass takes {means[OURS]:.1f} times as long as the primal image of "
        f"`path` ({peers}; geometric means over the sweeps). `psdr_path` records paths: its memory grows with samples, "
        f"up to {number(most)} MiB here."
    )


def place(machine: dict[str, Any]) -> str:
    """Processor, and device where one was used."""
    device = f"an {machine['gpu'].split(',')[0]} and " if "gpu" in machine else ""
    return f"{device}{machine['cores']} cores of {machine['cpu']}"


def machines(rows: list[dict[str, Any]]) -> str:
    """On what, and when, the rows were measured."""
    places = sorted({f"{place(row['machine'])}, {row['versions']['variant']}" for row in rows})
    days = sorted(row["date"][:10] for row in rows)
    when = days[0] if days[0] == days[-1] else f"{days[0]} to {days[-1]}"
    return f"Measured {when} on {' and '.join(places)}."


def has_signal(row: Row) -> bool:
    """Could differences tell the derivative of a check from zero?"""
    return not row["reason"].startswith(NO_SIGNAL)


def lists_anywhere(here: list[Row], on_cuda: list[Row]) -> list[Row]:
    """Rows of lists of checks: those made here, and those of lists that were run on a device only."""
    known = {row["settings"]["list"] for row in here}
    return [*here, *(row for row in on_cuda if row["bench"] == "check_lists" and row["settings"]["list"] not in known)]


def lists_words(rows: list[Row]) -> str:
    """What the checks of lists came to: how many are known well, and by how much these are off; empty without rows."""
    found = []
    for name in dict.fromkeys(row["settings"]["list"] for row in rows):
        listed = [row for row in rows if row["settings"]["list"] == name]
        bound = listed[0]["settings"]["max_stderr"]  # one for all of a list
        known = [row for row in listed if row["gain_stderr"] <= bound and has_signal(row)]
        off = max((abs(row["gain"] - 1) for row in known), default=0)
        failed = sum(row["verdict"] == "fail" for row in listed)
        where = " (on the GPU)" if listed[0]["machine"].get("gpu") else ""
        words = f"of {len(listed)} of `{name}`{where} {len(known)} have a standard error of at most {bound:g}"
        found.append(f"{words} and are off by at most {off:.3f}, {failed} fail")
    return f"Lists of checks, gains against differences: {'; '.join(found)}." if found else ""


def on_cuda(rows: list[Row]) -> str:
    """How many gradient checks pass on a GPU, and what a backward pass costs there; empty without rows."""
    checks = [row for row in rows if row["bench"] == "checks"]
    if not checks:
        return ""
    passed = sum(row["verdict"] == "pass" for row in checks)
    gpu = checks[0]["machine"]["gpu"].split(",")[0]
    words = f"[On a GPU](benchmarks/results/cuda/README.md) ({gpu}) {passed} of {len(checks)} gradient checks pass"
    passes = {row["method"]: row for row in rows if row["bench"] == "backward_cost" and "wall_ms" in row}
    if not passes:
        return f"{words}."
    s = next(iter(passes.values()))["settings"]
    took = {name.split(",")[0].split(" ")[0]: f"{row['wall_ms']['median']:.0f} ms" for name, row in passes.items()
            if name in (f"{OURS}, every term", "prb") or name.startswith("prb_projective")}  # fmt: skip
    peers = ", ".join(f"`{name}` {time}" for name, time in took.items() if name != OURS)
    return f"{words}; a backward pass ({s['res']} x {s['res']}, {s['spp']} spp) takes {took[OURS]} there ({peers})."
