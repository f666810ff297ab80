"""Charts and tables from stored rows, and the generated blocks of README.md. Measures nothing.

All tables go to the README of the folder of results; the main one gets the table of what is supported and three charts.

    psdr bench --report                     rewrite all
    python -m benchmarks.report --check     exit status 1 if a table is out of date
"""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path
from typing import Any

from benchmarks import inverse_tables, planning_tables, rows, sentences, survey_tables, tables
from psdr_jit.scene.capabilities import support_table

README = rows.ROOT / "README.md"
CUDA = "cuda"  # folder of rows measured with that backend
EMPTY = "No rows are stored yet; `psdr bench` makes some."
CHARTS = {
    "accuracy.png": "Relative error of the derivative image against seconds of rendering, per case and method",
    "images.png": "Derivative images after an equal time, and their signed errors",
    "ratios.png": "Ratios of the best prb_projective configuration to psdr_path, per case",
    "forms.png": "Variance x seconds of the spatial and the material form and of auto, per scene",
    "stability.png": "Gain along sweeps towards where methods fail",
    "cost.png": "Milliseconds and memory of a call against samples, resolution, depth, edges and parameters",
}
SWEEPS = (
    "Sweeps towards where methods fail. Gain is the slope against finite differences, 1 is right; bold: off by more "
    "than 0.05 and two standard errors."
)
PLANS = (
    "What a lean plan saves against a full one (equal budgets, spatial form, 64 x 64 pixels, 16 paths per pixel and "
    "term). The derivatives agree within their noise: z-scores of 8 x 8 pixel blocks. Then material gradients beside "
    "Mitsuba's `prb`."
)
OPTIMISATIONS = (
    "The optimisations of `scenes/inverse`, from their own start and from two random ones; bold: not solved. "
    "`prb_projective` (no guiding) runs the same loop for the same time, with learning rates that decay over as many "
    "iterations as fit into it."
)
ITERATIONS = "What an iteration consists of, at 256 x 256 pixels and 16 samples per pixel (medians):"
SCALING = (
    "Efficiency of a simulated cluster: workers that wait instead of computing, all in one process "
    "(`benchmarks/scaling.py`). Of local processes: their throughput divided by that of one process on all cores."
)
QUARTILES = "Medians, and quartiles in brackets."
WHAT_IS_WHAT = (
    "Made by `psdr bench --report` from the rows beside this file. Errors are relative to the root mean square of the "
    "reference derivative image. The gain is the least-squares slope against the reference (finite differences in the "
    "sweeps). Bias: root mean square of what no number of renders would cure, or the bound below which it is not seen. "
    "Heavy-tail index: share of the squared error in the top 0.1 % of pixel values, 0.004 for normal noise."
)


def readme_charts(found: list[dict[str, Any]]) -> str:
    """What the main README shows: three charts, what each says, other scenes, and where all that was measured."""
    of = grouped(found)
    makers = {"accuracy": sentences.accuracy, "stability": sentences.stability, "cost": sentences.cost}
    blocks = [f"{pictures(rows.RESULTS, f'{name}.png', at='benchmarks/results/')}\n{make(of[name])}"
              for name, make in makers.items() if of.get(name)]  # fmt: skip
    if of.get("public_scenes"):
        blocks.append(survey_tables.sentence(of["public_scenes"]))
    shown = [row for name in (*makers, "public_scenes") for row in of.get(name, ())]
    if not blocks:
        return EMPTY
    on_cuda = stored_rows(rows.RESULTS / CUDA)
    places = [sentences.machines(shown), sentences.on_cuda(on_cuda)]
    places.append(sentences.lists_words(sentences.lists_anywhere(of.get("check_lists", []), on_cuda)))
    return "\n\n".join(blocks) + "\n" + " ".join(filter(None, places))


def details(found: list[dict[str, Any]], folder: Path) -> str:
    """The README of a folder of results: every chart and every table, summaries first."""
    of = grouped(found)
    blocks = [f"## {title}\n\n" + "\n\n".join(part for part in make() if part)
              for title, there, make in sections(of, folder) if there]  # fmt: skip
    return "\n\n".join(["# Results", WHAT_IS_WHAT, *blocks, "## Circumstances", *circumstances(found)]) + "\n"


def sections(of: dict[str, list[dict[str, Any]]], folder: Path) -> list[tuple[str, Any, Any]]:
    """`(title, rows it draws on, its parts)` of the README of a folder of results."""
    measured, planned, inverse = of.get("accuracy", []), of.get("planning", []), of.get("inverse", [])
    swept, costs, passes = of.get("stability", []), of.get("cost", []), of.get("backward_cost", [])
    lines, public = tables.summary(measured), of.get("public_scenes", [])

    def shown(*names: str) -> str:
        return pictures(folder, *names)

    return [
        ("Accuracy against speed", lines, lambda: (
            tables.summary_words(lines), tables.summary_table(lines),
            shown("accuracy.png", "images.png", "ratios.png"))),
        ("Plans, forms and budgets", planned, lambda: (
            PLANS, planning_tables.plan_table(planned), planning_tables.prb_table(planned),
            planning_tables.forms_words(planned), shown("forms.png"))),
        ("Optimisations", inverse, lambda: (
            OPTIMISATIONS, inverse_tables.outcome_table(inverse), optimised_pictures(folder), ITERATIONS,
            inverse_tables.overhead_table(inverse))),
        ("Stability", swept, lambda: (SWEEPS, tables.stability_table(swept), shown("stability.png"))),
        ("Cost", costs, lambda: (shown("cost.png"),)),
        ("Backward passes", passes, lambda: (
            timing_table([row for row in passes if "wall_ms" in row]), QUARTILES)),
        ("Workers", of.get("scaling"), lambda: (SCALING, scaling_table(of["scaling"]))),
        ("Checks against finite differences", of.get("checks"), lambda: (check_table(of["checks"]),)),
        ("Lists of checks, every row", of.get("check_lists"), lambda: (
            sentences.lists_words(of["check_lists"]), check_table(of["check_lists"]))),
        ("Convergence", of.get("convergence"), lambda: (convergence_table(of["convergence"]),)),
        ("Scenes by others, every row", public, lambda: (
            survey_tables.sentence(public), survey_tables.undecided_words(public), survey_tables.table(public))),
        ("References, every row", of.get("references"), lambda: (
            tables.reference_table(of["references"], measured),)),
        ("Accuracy against speed, every row", measured, lambda: (tables.accuracy_table(measured),)),
        ("Forms and budgets, every row", planned, lambda: (planning_tables.forms_table(planned),)),
        ("Stability, every row", swept, lambda: (tables.stability_details(swept),)),
        ("Cost, every row", costs, lambda: (tables.cost_table(costs),)),
        ("Interior variance", passes, lambda: (variance_table([row for row in passes if "variance" in row]),)),
    ]  # fmt: skip


def grouped(found: list[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """Rows by benchmark."""
    names = dict.fromkeys(row["bench"] for row in found)
    return {name: [row for row in found if row["bench"] == name] for name in names}


def pictures(folder: Path, *names: str, at: str = "") -> str:
    """Links to the charts that a folder of results has; `at` leads from the linking file to the folder."""
    there = [name for name in names if (folder / "charts" / name).is_file()]
    return "\n\n".join(f"![{CHARTS[name]}]({at}charts/{name})" for name in there)


def optimised_pictures(folder: Path) -> str:
    """Links to the strips of images before and after."""
    links = []
    words_of = {"result": "initial, final, target, error", "section": "cross-section and displacement"}
    for path in sorted((folder / "inverse").glob("*.png")):
        name, _, kind = path.stem.rpartition("_")
        if kind not in words_of:
            continue
        words = f"{name}: {words_of[kind]}"
        links.append(f"![{words}](inverse/{path.name})")
    return "\n\n".join(links)


def stored_rows(folder: Path) -> list[dict[str, Any]]:
    return rows.latest(rows.read(sorted(folder.glob("*.jsonl"))))


def draw(folder: Path) -> list[Path]:
    """Every chart that there are rows for."""
    from benchmarks import charts

    of = grouped(stored_rows(folder))
    into, made = folder / "charts", []
    if of.get("accuracy"):
        made.append(charts.error_against_time(of["accuracy"], into / "accuracy.png"))
        made.append(charts.derivative_images(folder, into / "images.png"))
        if lines := tables.summary(of["accuracy"]):
            made.append(charts.ratios(lines, into / "ratios.png", planning_tables.forms(of.get("planning", []))))
    if of.get("planning"):
        made.append(charts.forms(planning_tables.forms(of["planning"]), into / "forms.png"))
    if of.get("stability"):
        made.append(charts.stability(of["stability"], into / "stability.png"))
    if of.get("cost"):
        made.append(charts.costs(of["cost"], into / "cost.png"))
    return [path for path in made if path is not None]


def write(folder: Path) -> int:
    """Charts and tables of a folder of rows; of the repository's own, the README's blocks as well."""
    if not stored_rows(folder):
        print(f"psdr bench: error: there are no rows in {folder}; run psdr bench first", file=sys.stderr)
        return 2
    for path in draw(folder):
        print(f"wrote {path}")
    (folder / "README.md").write_text(details(stored_rows(folder), folder), encoding="utf-8")
    print(f"wrote {folder / 'README.md'}")
    if folder == rows.RESULTS:
        README.write_text(current(), encoding="utf-8")
        print(f"wrote {README}")
    return 0


def current() -> str:
    """The README with its blocks as the code and the rows have it."""
    text = with_block(README.read_text(encoding="utf-8"), "support", support_table())
    return with_block(text, "bench", readme_charts(stored_rows(rows.RESULTS)))


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


def scaling_table(found: list[dict[str, Any]]) -> str:
    """Median efficiency by number of workers, the least of the runs, and processor time where work is only waited for.
    """
    lines = ["| work | workers | efficiency | least | processor time of a run [s] |", "|---|---|---|---|---|"]
    for row in found:
        for count, e in row["efficiency"].items():
            busy = f"{row['cpu_seconds'][count]['median']:.2f}" if "cpu_seconds" in row else ""
            what = f"{row['case']}, {row['method']}"
            lines.append(f"| {what} | {count} | {e['median']:.2f} | {e['min']:.2f} | {busy} |")
    return "\n".join(lines)


def variance_table(found: list[dict[str, Any]]) -> str:
    lines = ["| case | estimate | mean pixel variance | from halves of the seeds |", "|---|---|---|---|"]
    for row in found:
        v = row["variance"]
        halves = " and ".join(f"{half:.3g}" for half in v["halves"])
        lines.append(f"| {describe(row)}, {len(row['seeds'])} seeds | {row['method']} | {v['mean']:.3g} | {halves} |")
    return "\n".join(lines)


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


def describe(row: dict[str, Any]) -> str:
    s = row["settings"]
    return f"{row['case']}, {s['res']} x {s['res']}, {s['spp']} spp, max_depth {s['max_depth']}"


def circumstances(found: list[dict[str, Any]]) -> list[str]:
    """One line for each benchmark, machine and commit that the tables draw on."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for row in found:
        machine, v = row["machine"], row["versions"]
        text = (
            f"{row['bench']}: {row['date'][:10]}, {sentences.place(machine)}, "
            f"Mitsuba {v['mitsuba']}, Dr.Jit {v['drjit']}, {backend(v)}, {v['variant']}, commit {row['commit']}"
        )
        groups.setdefault(text, []).append(row)
    lines = []
    for text in sorted(groups):
        loads = [row["load"] for row in groups[text]]
        lines.append(f"- {text}, load {min(loads):.1f} to {max(loads):.1f}")
    return ["\n".join(lines)]


def backend(versions: dict[str, str]) -> str:
    """What compiled the kernels."""
    return f"CUDA {versions['cuda']}" if "cuda" in versions else f"LLVM {versions['llvm']}"


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
    if not args.check:
        return write(rows.RESULTS)
    stale = current() != README.read_text(encoding="utf-8")
    written = (rows.RESULTS / "README.md").read_text(encoding="utf-8")
    stale |= written != details(stored_rows(rows.RESULTS), rows.RESULTS)
    if stale:
        print("README.md is out of date; run:  psdr bench --report", file=sys.stderr)
    return int(stale)


if __name__ == "__main__":
    sys.exit(main())
