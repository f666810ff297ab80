"""Tables of the suite `inverse`."""

from __future__ import annotations

from typing import Any

from benchmarks.tables import markdown

OURS, PEER = "psdr_path", "prb_projective"
CAMERA_PATHS = "psdr_path without light subpaths"  # where the example has psdr_bdpt, in equal time
OVERHEAD = "overhead: "  # begins the names of cases that take the time of an iteration apart

UNITS = {"angle_degrees": "angle [degrees]", "rms": "RMS displacement", "chamfer": "Chamfer distance",
         "distance": "distance / size", "lamp": "lamp: distance / size", "blocker": "box: distance / size",
         "ior": "refractive index", "spot": "spot: distance / size", "caustic": "RMS of the caustic's image",
         "left": "left lamp: relative brightness",
         "right": "right lamp: relative brightness"}  # fmt: skip


def outcome_table(found: list[dict[str, Any]]) -> str:
    """Every example and start: the error before, after, and by the peer in equal time."""
    lines = []
    runs = [r for r in found if not r["case"].startswith(OVERHEAD)]
    for case in dict.fromkeys(r["case"] for r in sorted(runs, key=lambda r: r["family"])):
        of = {r["method"]: r for r in found if r["case"] == case}
        ours, peer, alone = (of.get(method) for method in (OURS, PEER, CAMERA_PATHS))
        if ours is None or ours["status"] != "ok":
            lines.append([case, "", "", f"cannot: {ours['error']}" if ours else "", "", "", ""])
            continue
        for k, name in enumerate(ours["limits"]):
            after = f"{ours['after'][name]:.3g}"
            there = peer is not None and peer["status"] == "ok"
            theirs = f"{peer['after'][name]:.3g}" if there else "cannot"
            lines.append([
                case if k == 0 else "", UNITS[name], f"{ours['before'][name]:.3g}", f"{ours['limits'][name]:.3g}",
                after if ours["after"][name] < ours["limits"][name] else f"**{after}**",
                f"{ours['seconds']:.0f} s, {ours['iterations']}" if k == 0 else "",
                theirs, f"{peer['seconds']:.0f} s, {peer['iterations']}" if there and k == 0 else "",
            ])  # fmt: skip
        if alone is not None and alone["status"] == "ok":
            lines += _alone(case, alone)
    head = ("example", "error", "start", "solved below", OURS, "time, iterations", PEER, "time, iterations")
    return markdown(head, lines)


def _alone(case: str, row: dict[str, Any]) -> list[list[str]]:
    """Lines of an example of `psdr_bdpt` as `psdr_path` solves it."""
    return [
        [f"{case}, without light subpaths" if k == 0 else "", UNITS[name], f"{row['before'][name]:.3g}",
         f"{limit:.3g}", f"{row['after'][name]:.3g}", f"{row['seconds']:.0f} s, {row['iterations']}" if k == 0 else "",
         "", ""]
        for k, (name, limit) in enumerate(row["limits"].items())
    ]  # fmt: skip


def overhead_table(found: list[dict[str, Any]]) -> str:
    """What an iteration consists of."""
    lines = []
    for r in (r for r in found if r["case"].startswith(OVERHEAD) and r["status"] == "ok"):
        lines.append([
            r["case"].removeprefix(OVERHEAD), str(r["settings"]["views"]), f"{r['wall_ms']['median']:.0f}",
            f"{r['kernel_ms']['median']:.0f}", f"{r['outside_kernels_ms']['median']:.0f}",
            f"{100 * r['outside_share']['median']:.0f} %",
        ])  # fmt: skip
    head = ("example", "views", "iteration [ms]", "kernels [ms]", "Python and tracing [ms]", "share")
    return markdown(head, lines)
