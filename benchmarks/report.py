"""Writes the generated blocks of README.md: what is supported, and the stored benchmark rows. Computes nothing else.

    python -m benchmarks.report             rewrite the blocks
    python -m benchmarks.report --check     exit status 1 if a block is out of date
"""

from __future__ import annotations

import argparse
import math
import re
import sys
from typing import Any

from benchmarks import rows
from psdr_jit.support import support_table

README = rows.ROOT / "README.md"
EMPTY = "No rows are stored yet; `python -m benchmarks.backward_cost` makes some."


def benchmark_tables() -> str:
    """The newest row of every case and method, as Markdown."""
    found = rows.latest(rows.read(sorted(rows.RESULTS.glob("*.jsonl"))))
    by_bench = {name: [row for row in found if row["bench"] == name] for name in {row["bench"] for row in found}}
    cost = by_bench.get("backward_cost", [])
    parts = (
        (efficiency_table, by_bench.get("efficiency", [])),
        (timing_table, [row for row in cost if "wall_ms" in row]),
        (variance_table, [row for row in cost if "variance" in row]),
        (check_table, by_bench.get("checks", [])),
        (convergence_table, by_bench.get("convergence", [])),
        (call_table, by_bench.get("large_mesh", [])),
    )
    blocks = [table(some) for table, some in parts if some]
    return "\n\n".join([*blocks, *circumstances(found)]) if blocks else EMPTY


def timing_table(found: list[dict[str, Any]]) -> str:
    """Medians with quartiles, and the wall time relative to the primal of the same run."""
    lines = ["| case | method | wall time [ms] | kernel time [ms] | relative to `path` |", "|---|---|---|---|---|"]
    primal = {(row["case"], row["date"]): row for row in found if "primal" in row["method"]}
    for row in found:
        base = primal.get((row["case"], row["date"]))
        ratio = f"{row['wall_ms']['median'] / base['wall_ms']['median']:.2f}" if base else "-"
        times = [f"{t['median']:.0f} ({t['q1']:.0f} to {t['q3']:.0f})" for t in (row["wall_ms"], row["kernel_ms"])]
        lines.append(f"| {describe(row)} | {row['method']} | {times[0]} | {times[1]} | {ratio} |")
    return "\n".join(lines)


def variance_table(found: list[dict[str, Any]]) -> str:
    lines = ["| case | estimate | mean pixel variance | from halves of the seeds |", "|---|---|---|---|"]
    for row in found:
        v = row["variance"]
        halves = " and ".join(f"{half:.3g}" for half in v["halves"])
        lines.append(f"| {describe(row)}, {len(row['seeds'])} seeds | {row['method']} | {v['mean']:.3g} | {halves} |")
    return "\n".join(lines)


def efficiency_table(found: list[dict[str, Any]]) -> str:
    """Variance × seconds of every method, and how much better ours is than the best of the others."""
    lines = [
        "| case | method | pixel variance | seconds | variance x seconds | relative to ours | gain |",
        "|---|---|---|---|---|---|---|",
    ]
    ratios = []
    for case in dict.fromkeys(row["case"] for row in found):
        methods = [row for row in found if row["case"] == case]
        ours = next(row for row in methods if row["method"] == "psdr_path")
        peers = [row["cost"] / ours["cost"] for row in methods if row is not ours]
        ratios += [min(peers)] if peers else []
        for row in methods:
            gain = f"{row['gain']:.3f} +- {row['gain_stderr']:.3f}"
            lines.append(
                f"| {describe(row)} | {row['method']} | {row['variance']:.2e} | {row['seconds']['median']:.3f} | "
                f"{row['cost']:.2e} | {row['cost'] / ours['cost']:.3g} | {gain} |"
            )
    mean = math.exp(sum(math.log(r) for r in ratios) / len(ratios)) if ratios else float("nan")
    return "\n".join(lines) + (
        f"\n\nAgainst the best configuration of `prb_projective` in each case: {min(ratios):.3g} times to "
        f"{max(ratios):.3g} times less variance x seconds, {mean:.3g} times in the geometric mean. The gain is "
        "measured against finite differences: 1 is right."
    )


def check_table(found: list[dict[str, Any]]) -> str:
    """`psdr gradient --check` on one scene per phenomenon."""
    lines = ["| check against finite differences | gain | RMS z | max abs z | verdict |", "|---|---|---|---|---|"]
    for row in found:
        gain, z = f"{row['gain']:.4f} +- {row['gain_stderr']:.4f}", f"{row['rms_z']:.2f} | {row['max_z']:.1f}"
        lines.append(f"| {row['case']} | {gain} | {z} | {row['verdict']} |")
    return "\n".join(lines)


def convergence_table(found: list[dict[str, Any]]) -> str:
    """Error against samples."""
    renders = found[0]["settings"]["renders"]
    head = " | ".join(f"RMSE, {n} renders" for n in renders)
    lines = [f"| case | {head} | error of the reference | slope |", "|---|" + "---|" * (len(renders) + 2)]
    for row in found:
        errors = " | ".join(f"{e:.2e}" for e in row["rmse"])
        lines.append(f"| {row['case']} | {errors} | {row['reference_error']:.1e} | {row['slope']:.3f} |")
    return "\n".join(lines)


def call_table(found: list[dict[str, Any]]) -> str:
    """Seconds of a call."""
    lines = ["| case | method | seconds a call |", "|---|---|---|"]
    for row in found:
        t = row["seconds"]
        median, q1, q3 = t["median"], t["q1"], t["q3"]
        lines.append(f"| {describe(row)} | {row['method']} | {median:.3f} ({q1:.3f} to {q3:.3f}) |")
    return "\n".join(lines)


def describe(row: dict[str, Any]) -> str:
    s = row["settings"]
    return f"{row['case']}, {s['res']} x {s['res']}, {s['spp']} spp, max_depth {s['max_depth']}"


def circumstances(found: list[dict[str, Any]]) -> list[str]:
    """One line for each benchmark, machine and commit that the tables draw on."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for row in found:
        machine, v = row["machine"], row["versions"]
        text = (
            f"{row['bench']}: {row['date'][:10]}, {machine['cores']} cores of {machine['cpu']}, "
            f"Mitsuba {v['mitsuba']}, Dr.Jit {v['drjit']}, LLVM {v['llvm']}, {v['variant']}, commit {row['commit']}"
        )
        groups.setdefault(text, []).append(row)
    lines = []
    for text in sorted(groups):
        loads = [row["load"] for row in groups[text]]
        lines.append(f"- {text}, load {min(loads):.1f} to {max(loads):.1f}")
    return ["Medians and quartiles.\n\n" + "\n".join(lines)]


def with_block(text: str, name: str, content: str) -> str:
    """`text` with everything between the markers of block `name` replaced."""
    pattern = re.compile(rf"(<!-- {name}:begin[^>]*-->\n).*?(<!-- {name}:end -->)", re.DOTALL)
    if not pattern.search(text):
        sys.exit(f"README.md has no block '{name}'")
    return pattern.sub(lambda match: f"{match[1]}{content}\n{match[2]}", text)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="change nothing")
    args = parser.parse_args()
    before = README.read_text(encoding="utf-8")
    after = with_block(with_block(before, "support", support_table()), "bench", benchmark_tables())
    if args.check:
        if after != before:
            print("README.md is out of date; run:  python -m benchmarks.report", file=sys.stderr)
        return int(after != before)
    README.write_text(after, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
