"""Scene files that others have written: what becomes of the things in them that can move, stored as rows.

    python -m benchmarks.public_scenes FOLDER...            (hours; append to benchmarks/results/public_scenes.jsonl)
    python -m benchmarks.public_scenes FOLDER --part 0/2    (every second one, for two processes side by side)
    python -m benchmarks.public_scenes FOLDER --again       (what went wrong, then what is undecided)
    python -m benchmarks.public_scenes FOLDER --again --variant cuda_ad_rgb --spp 512 --reference-spp 8192   (on a GPU)

Each thing is moved a little, and compared with differences for so many seconds. What has a row is not done again. The
first thing of every scene comes first, then the second of every scene: interrupted, a run has seen most scenes.
"""

from __future__ import annotations

import argparse
import random
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import mitsuba as mi

from benchmarks import rows
from benchmarks.survey import (
    DEPTH,
    NOT_FINITE,
    SIDE,
    UNDECIDED,
    WRONG,
    Effort,
    Row,
    movable,
    row_of,
    shrunk,
    spread,
)
from psdr_jit.errors import PsdrError
from psdr_jit.scene import io as scene_io

BENCH = "public_scenes"
SECONDS, MOST = 40.0, 3  # of a check; things of a scene
ORDER = 1  # seed of the order in which scenes are looked at
ERROR = "error"  # what becomes of a thing if none of the words of `survey` fits


@dataclass
class Corpus:
    """The scene files of some folders, and the names of what is moved in each."""

    folders: list[Path]
    most: int
    part: tuple[int, int]  # which of how many
    moved: dict[Path, list[str]] = field(default_factory=dict)

    def files(self) -> list[tuple[str, Path]]:
        """`(name, path)`, the names beginning with that of their folder; shuffled, as neighbours are much alike."""
        found = [(f"{folder.name}/{path.relative_to(folder)}", path)
                 for folder in self.folders for path in sorted(folder.rglob("*.xml"))]  # fmt: skip
        random.Random(ORDER).shuffle(found)
        return found

    def share(self, things: list) -> list:
        """Of things that several processes do, those that this one does."""
        return things[self.part[0] :: self.part[1]]

    def names(self, path: Path) -> list[str]:
        """What is moved in a scene; nothing in a file that cannot be loaded, such as a part of others."""
        if path not in self.moved:
            scene = self.load(path)
            infos = [] if scene is None else spread(movable(scene), self.most)
            self.moved[path] = [info.name for info in infos]
        return self.moved[path]

    def load(self, path: Path) -> mi.Scene | None:
        try:
            return shrunk(scene_io.load_scene(path))
        except PsdrError as error:
            print(f"{path.name}: not loaded: {str(error).splitlines()[0]}", flush=True)
            return None

    def pairs(self) -> Iterator[tuple[str, Path, str]]:
        """`(name of the file, path, parameter)`, one of each scene, then a second of each.

        Cameras, lights and shapes, which stand in this order, take turns from scene to scene.
        """
        for turn in range(self.most):
            for number, (name, path) in enumerate(self.share(self.files())):
                chosen = self.names(path)
                if turn < len(chosen):
                    yield name, path, chosen[(turn + number) % len(chosen)]


def undecided(corpus: Corpus, known: list[dict[str, Any]]) -> list[tuple[str, Path, str]]:
    """Of the pairs that have rows, those that went wrong, then those without a verdict by the error of their gain."""
    error = {row["case"]: row["stderr"] or float("inf") for row in known if row["word"] == UNDECIDED}
    error |= {row["case"]: 0.0 for row in known if row["word"] in (WRONG, NOT_FINITE, ERROR)}
    found = [(name, path, case.removeprefix(f"{name}: "))
             for name, path in corpus.files() for case in error if case.startswith(f"{name}: ")]  # fmt: skip
    return corpus.share(sorted(found, key=lambda pair: error[case_of(pair[0], pair[2])]))


def case_of(name: str, param: str) -> str:
    return f"{name}: {param}"


def measure(corpus: Corpus, path: Path, param: str, effort: Effort) -> Row:
    """The row of one thing; an error that is not one of ours is a row as well."""
    start = time.perf_counter()
    try:
        scene = corpus.load(path)
        info = next(info for info in movable(scene) if info.name == param)
        return row_of(scene, path.name, info, effort)
    except Exception as error:  # noqa: BLE001  told, counted, and the next one is tried
        text = f"{type(error).__name__}: {error}"
        return Row(path.name, param, ERROR, None, None, text, time.perf_counter() - start)


def stored(row: Row, case: str, effort: Effort) -> dict[str, Any]:
    settings = {"side": SIDE, "max_depth": DEPTH, **asdict(effort), "motion": row.motion}
    figures = {key: value for key, value in row.as_dict().items() if key not in ("scene", "param", "motion")}
    return {"bench": BENCH, "case": case, "method": "psdr_path", "settings": settings, **figures}


def part_of(text: str) -> tuple[int, int]:
    which, _, count = text.partition("/")
    if not (which.isdigit() and count.isdigit() and int(which) < int(count)):
        raise argparse.ArgumentTypeError(f"'{text}' is not of the form K/N with 0 <= K < N")
    return int(which), int(count)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="limit of a check (default: %(default)g)")
    parser.add_argument("--most", type=int, default=MOST, help="things moved in a scene (default: %(default)s)")
    parser.add_argument("--part", type=part_of, default=(0, 1), metavar="K/N", help="every Nth one, from the Kth on")
    parser.add_argument("--out", type=Path, default=rows.RESULTS / f"{BENCH}.jsonl")
    parser.add_argument("--again", action="store_true", help="look at what is undecided, or went wrong, once more")
    parser.add_argument("--variant", default=scene_io.DEFAULT_VARIANT)
    parser.add_argument("--spp", type=int, default=Effort.spp, help="of an estimate (default: %(default)s)")
    parser.add_argument("--reference-spp", type=int, help="of differences (default: as many as keep start-up small)")
    args = parser.parse_args()
    scene_io.use_variant(args.variant)
    effort = Effort(args.seconds, args.spp, args.reference_spp)
    mi.set_log_level(mi.LogLevel.Error)
    known = rows.latest(rows.read([args.out])) if args.out.exists() else []
    corpus, bad = Corpus(args.folders, args.most, args.part), 0
    done = set() if args.again else {row["case"] for row in known}
    for name, path, param in undecided(corpus, known) if args.again else corpus.pairs():
        case = case_of(name, param)
        if case in done:
            continue
        row = measure(corpus, path, param, effort)
        rows.append(args.out, {**stored(row, case, effort), **rows.circumstances()})
        bad += row.word in (WRONG, NOT_FINITE, ERROR)
        gain = "" if row.gain is None or row.stderr is None else f"{row.gain:.3f} +- {row.stderr:.3f}"
        print(f"{case}  {row.word}  {gain}  {row.seconds:.0f} s  {row.reason.partition(chr(10))[0]}", flush=True)
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
