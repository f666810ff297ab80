"""Charts from stored rows and images. Computes nothing that a row does not say. Readable in grayscale."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import accuracy, cases, references, tables
from benchmarks import cost as cost_suite
from benchmarks import stability as stability_suite
from benchmarks.planning import AUTO, EQUAL_BUDGETS, MATERIAL, SPATIAL

DPI = 200
INK, LIGHT = "0.15", "0.75"
#: method -> (colour, line style, marker); luminance and dashes tell them apart without colour.
STYLES = {
    "psdr_path": ("#000000", "-", "o"),
    "psdr_bdpt": ("#4d4d4d", "--", "h"),
    "prb": ("#8c8c8c", ":", "x"),
    "prb_projective, no guiding": ("#c1272d", "--", "s"),
    "prb_projective, small octree": ("#e07b00", "-.", "^"),
    "prb_projective, default octree": ("#b8860b", ":", "v"),
    "direct_projective, small octree": ("#7a5195", "--", "D"),
    "finite differences": ("#2a7f9e", "-", "+"),
    "edge sampling": ("#3a7d44", "-.", "*"),
    "prb_reparam": ("#5b7fd4", "--", "P"),
    "path (primal)": ("#8c8c8c", "-", "x"),
    "psdr_path forward": ("#000000", "--", "o"),
    "psdr_path backward": ("#000000", "-", "o"),
    "prb backward": ("#2a7f9e", ":", "v"),
    "prb_projective backward, no guiding": ("#c1272d", "--", "s"),
}  # fmt: skip
PICTURED = ("area shadow", "cbox contact", "branching", "rough glass, spot moved")
PICTURED_METHODS = ("psdr_path", "prb_projective, small octree", "prb_projective, no guiding", "edge sampling",
                    "prb_reparam", "finite differences")  # fmt: skip
PANEL_COLUMNS = 5
PANEL_WIDTH, LEAST_WIDTH, LEGEND_HEIGHT = 2.1, 8.0, 0.6  # [in]
GAIN_LIMITS = (-0.1, 2.1)  # of the axis; what lies outside is drawn at its edge
RATIOS = (
    "best prb_projective / psdr_path\n"
    "filled circle: variance × seconds; open circle: the same where the peer misses more than half\n"
    "of the derivative or doubles it; diamond: mean squared error after 10 s; square: ours against ours with equal\n"
    "budgets in the spatial form, geometric mean of the scenes (ticks)"
)
FORM_MARKERS = {SPATIAL: ("s", "#c1272d", "none"), MATERIAL: ("^", "#2a7f9e", "none"), AUTO: (".", "black", "black")}
TARGET, LEAST = 50, 5  # ratios of variance × seconds that the project wants on average and everywhere


def plain_axes(axis: Any) -> None:
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)
    axis.tick_params(labelsize=6, width=0.5, length=2)
    for side in ("left", "bottom"):
        axis.spines[side].set_linewidth(0.5)


def panels(count: int, height: float) -> tuple[Any, list[Any]]:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    lines = -(-count // PANEL_COLUMNS)
    columns = min(count, PANEL_COLUMNS)
    size = (max(PANEL_WIDTH * columns, LEAST_WIDTH), height * lines + LEGEND_HEIGHT)
    figure, axes = plt.subplots(lines, columns, figsize=size, squeeze=False)
    flat = list(axes.ravel())
    for axis in flat[count:]:
        axis.set_visible(False)
    for axis in flat[:count]:
        plain_axes(axis)
    return figure, flat[:count]


def save(figure: Any, path: Path) -> Path:
    import matplotlib.pyplot as plt

    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=DPI)
    plt.close(figure)
    return path


def legend(figure: Any, handles: dict[str, Any], columns: int) -> None:
    figure.legend(handles.values(), handles.keys(), loc="lower center", ncols=columns, fontsize=7, frameon=False)


def labelled(figure: Any, vertical: str, horizontal: str) -> None:
    """Labels for all panels together, with room for a legend below."""
    below = LEGEND_HEIGHT / figure.get_figheight()
    if vertical:
        figure.supylabel(vertical, fontsize=8, x=0.005)
    if horizontal:
        figure.supxlabel(horizontal, fontsize=8, y=0.7 * below)
    figure.tight_layout(rect=(0.015, 0.6 * below, 1, 1), w_pad=0.4, h_pad=0.8)


def draw(axis: Any, method: str, x: Sequence[float], y: Sequence[float]) -> Any:
    colour, style, marker = STYLES[method]
    width = 1.4 if method.startswith("psdr_path") else 0.9
    (line,) = axis.plot(x, y, color=colour, linestyle=style, marker=marker, markersize=3, linewidth=width)
    return line


def error_against_time(rows: list[dict[str, Any]], path: Path) -> Path:
    """Relative RMSE of cumulative means against seconds; the dotted line is the error of the reference itself."""
    done = [row for row in rows if row["status"] == "ok"]
    names = list(dict.fromkeys(row["case"] for row in done))
    figure, axes = panels(len(names), 1.8)
    handles: dict[str, Any] = {}
    for axis, name in zip(axes, names, strict=True):
        for row in (row for row in done if row["case"] == name):
            x, y = ([point[key] for point in row["curve"]] for key in ("seconds", "rmse"))
            handles.setdefault(row["method"], draw(axis, row["method"], x, y))
            axis.axhline(row["floor"], color=LIGHT, linestyle=":", linewidth=0.7)
        axis.set(xscale="log", yscale="log")
        axis.set_title(name, fontsize=7, color=INK, pad=3)
        axis.minorticks_off()
    labelled(figure, "relative RMSE of the derivative image", "seconds of rendering; dotted: error of the reference")
    legend(figure, {k: handles[k] for k in STYLES if k in handles}, 5)
    return save(figure, path)


def forms(found: list[dict[str, Any]], path: Path) -> Path | None:
    """Variance × seconds of each form relative to equal budgets in the spatial form, per scene."""
    if not found:
        return None
    figure, (axis,) = panels(1, 0.17 * len(found) + 1.2)
    figure.set_figwidth(7)
    heights = np.arange(len(found))[::-1]
    for name, (marker, colour, fill) in FORM_MARKERS.items():
        x = [f["rows"][name]["cost"] / f["rows"][EQUAL_BUDGETS]["cost"] for f in found]
        axis.plot(x, heights, marker, color=colour, markersize=4, markerfacecolor=fill, label=name)
    axis.axvline(1, color=LIGHT, linewidth=0.7)
    axis.set(xscale="log", yticks=heights)
    axis.set_yticklabels([f["case"] for f in found])
    axis.set_xlabel("variance × seconds, relative to the spatial form with equal budgets", fontsize=7)
    axis.legend(fontsize=7, frameon=False, loc="lower right")
    figure.tight_layout()
    return save(figure, path)


def ratios(summary: list[dict[str, Any]], path: Path, forms_found: Sequence[dict[str, Any]] = ()) -> Path:
    """How much better than the best `prb_projective` each case is, in variance × seconds and in error after 10 s.

    Below them, how much automatic budgets and forms win over equal budgets in the spatial form.
    """
    gains = tables.gains_of_plans(forms_found)
    figure, (axis,) = panels(1, 0.22 * (len(summary) + len(gains)) + 1.2)
    figure.set_figwidth(7)
    for k, (_, values) in enumerate(gains):
        axis.plot(values, [-1 - k] * len(values), "|", color="#2a7f9e", markersize=5, markeredgewidth=0.6)
        axis.plot([tables.geometric_mean(values)], [-1 - k], "s", color="black", markersize=4)
    heights = np.arange(len(summary))[::-1]
    for height, line in zip(heights, summary, strict=True):
        axis.plot([line["cost_ratio"]], [height], "o", color="black", markersize=4,
                  markerfacecolor="black" if line["does_it"] else "white")
        axis.plot([line["mse_ratio"]], [height], "D", color="#c1272d", markersize=4, markerfacecolor="none")
    axis.set(xscale="log", yticks=[*heights, *(-1 - k for k in range(len(gains)))])
    axis.set_yticklabels([*(line["case"] for line in summary), *(label for label, _ in gains)])
    for x, text in ((1, "equal"), (LEAST, f"{LEAST}x"), (TARGET, f"{TARGET}x")):
        axis.axvline(x, color=LIGHT, linewidth=0.7)
        axis.text(x, len(summary) - 0.4, text, fontsize=6, ha="center", color=INK)
    axis.set_xlabel(RATIOS, fontsize=7)
    figure.tight_layout()
    return save(figure, path)


def derivative_images(folder: Path, path: Path) -> Path | None:
    """Mean derivative image of each method after an equal time, over its signed error; one scale per case."""
    chosen = [case for case in cases.CASES
              if case.name in PICTURED and references.path_of(folder, case).is_file()
              and accuracy.image_path(folder, case).is_file()]  # fmt: skip
    if not chosen:
        return None
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    columns = ("reference", *PICTURED_METHODS)
    figure, axes = plt.subplots(2 * len(chosen), len(columns), figsize=(1.3 * len(columns), 2.7 * len(chosen) + 0.4),
                                squeeze=False, layout="constrained")  # fmt: skip
    figure.get_layout_engine().set(w_pad=0.01, h_pad=0.01, hspace=0.02, wspace=0.01)
    for axis in axes.ravel():
        axis.set(xticks=[], yticks=[])
        axis.set_frame_on(False)
    for k, case in enumerate(chosen):
        truth = references.read(folder, case).mean.mean(-1)
        stored = dict(np.load(accuracy.image_path(folder, case)))
        limit = np.percentile(np.abs(truth), 99.5) or np.abs(truth).max()
        look = {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit, "interpolation": "nearest"}
        image, error = axes[2 * k], axes[2 * k + 1]
        shown = image[0].imshow(truth, **look)
        image[0].set_ylabel(case.name, fontsize=8)
        error[0].set_aspect("equal")
        error[1].set_ylabel("error", fontsize=7)
        bar = figure.colorbar(shown, cax=error[0].inset_axes((0.55, 0.05, 0.08, 0.9)))
        bar.ax.yaxis.set_ticks_position("left")
        bar.ax.tick_params(labelsize=5)
        bar.ax.set_title("d radiance / d unit", fontsize=5, loc="right")
        for column, method in enumerate(PICTURED_METHODS, start=1):
            if method in stored:
                image[column].imshow(stored[method], **look)
                error[column].imshow(stored[method] - truth, **look)
            else:
                image[column].text(0.5, 0.5, "cannot", ha="center", fontsize=7, color=INK)
    for axis, name in zip(axes[0], columns, strict=True):
        axis.set_title(name.replace(", ", ",\n"), fontsize=7)
    return save(figure, path)


def stability(rows: list[dict[str, Any]], path: Path) -> Path:
    """Gain along each sweep; 1 is right. A cross at the lower edge: the method cannot do that step."""
    names = list(dict.fromkeys(row["sweep"] for row in rows if "sweep" in row))
    units = {sweep.name: sweep.unit for sweep in stability_suite.SWEEPS}
    figure, axes = panels(len(names), 1.7)
    handles: dict[str, Any] = {}
    for axis, name in zip(axes, names, strict=True):
        steps = list(dict.fromkeys(row["value"] for row in rows if row.get("sweep") == name))
        axis.axhspan(0.95, 1.05, color="0.88", linewidth=0)
        for method in dict.fromkeys(row["method"] for row in rows if row.get("sweep") == name):
            of_method = {row["value"]: row for row in rows if row.get("sweep") == name and row["method"] == method}
            x = [k for k, value in enumerate(steps) if of_method.get(value, {}).get("status") == "ok"]
            y = np.clip([of_method[steps[k]]["gain"] for k in x], *GAIN_LIMITS)
            handles.setdefault(method, draw(axis, method, x, y))
            missing = [k for k, value in enumerate(steps) if of_method.get(value, {}).get("status") == "cannot"]
            axis.plot(missing, [GAIN_LIMITS[0]] * len(missing), "x", color=STYLES[method][0], markersize=4)
        axis.set_ylim(GAIN_LIMITS[0] - 0.05, GAIN_LIMITS[1] + 0.05)
        axis.set_xticks(range(len(steps)), [f"{value:g}" for value in steps], fontsize=5)
        axis.set_xlabel(units.get(name, ""), fontsize=6, labelpad=1)
        axis.set_title(name, fontsize=7, color=INK, pad=3)
    labelled(figure, "gain against finite differences", "grey: within 0.05; crosses below: the method cannot do it")
    legend(figure, handles, 3)
    return save(figure, path)


def costs(rows: list[dict[str, Any]], path: Path) -> Path:
    """Milliseconds (upper line of panels) and MiB (lower) of a call along each sweep."""
    done = [row for row in rows if row["status"] == "ok"]
    names = list(dict.fromkeys(row["sweep"] for row in done))
    units = {sweep.name: sweep.unit for sweep in cost_suite.SWEEPS}
    figure, axes = panels(2 * len(names), 1.8)
    handles: dict[str, Any] = {}
    for k, name in enumerate(names):
        for method in dict.fromkeys(row["method"] for row in done if row["sweep"] == name):
            steps = [row for row in done if row["sweep"] == name and row["method"] == method]
            x = [row["value"] for row in steps]
            line = draw(axes[k], method, x, [row["wall_ms"]["median"] for row in steps])
            draw(axes[k + len(names)], method, x, [row["peak_mib"] for row in steps])
            handles.setdefault(method, line)
        for axis in (axes[k], axes[k + len(names)]):
            axis.set(xscale="log", yscale="log")
            axis.minorticks_off()
            axis.set_title(name, fontsize=7, color=INK, pad=3)
            axis.set_xlabel(units.get(name, ""), fontsize=6, labelpad=1)
    axes[0].set_ylabel("ms per call", fontsize=7)
    axes[len(names)].set_ylabel("peak memory [MiB]", fontsize=7)
    labelled(figure, "", "")
    legend(figure, handles, 5)
    return save(figure, path)
