"""Writes the generated blocks of README.md: what is supported, and the stored benchmark rows. Computes nothing else.

    python -m benchmarks.report             rewrite the blocks
    python -m benchmarks.report --check     exit status 1 if a block is out of date
"""

from __future__ import annotations

import argparse
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
    timings = [row for row in found if "wall_ms" in row]
    variances = [row for row in found if "variance" in row]
    blocks = [timing_table(timings)] if timings else []
    blocks += [variance_table(variances)] if variances else []
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


def describe(row: dict[str, Any]) -> str:
    s = row["settings"]
    return f"{row['case']}, {s['res']} x {s['res']}, {s['spp']} spp, max_depth {s['max_depth']}"


def circumstances(found: list[dict[str, Any]]) -> list[str]:
    """One line for each run that the tables draw on."""
    lines = {}
    for row in found:
        machine, v = row["machine"], row["versions"]
        lines[row["date"]] = (
            f"Measured {row['date'][:10]} on {machine['cores']} cores of {machine['cpu']} (load {row['load']:.1f}); "
            f"Mitsuba {v['mitsuba']}, Dr.Jit {v['drjit']}, LLVM {v['llvm']}, {v['variant']}, commit {row['commit']}. "
            "Medians and quartiles."
        )
    return [lines[date] for date in sorted(lines)]


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
