"""Many seeds in one process, a line each: `PYTHONPATH=tests:. python -m fuzz.run FIRST COUNT [KIND]`.

KIND is `specular` (with mirrors, glass, plastic, windows and masks), `bidirectional` (these by `psdr_bdpt`), `curved`
(with SDF grids, curves, ellipsoids and instances), `bent` (with bump and normal maps), or nothing.
"""

from __future__ import annotations

import sys

import mitsuba as mi
from fuzz.bent import bent_case_of
from fuzz.curved import curved_case_of
from fuzz.scenes import case_of
from fuzz.specular import bidirectional_case_of, specular_case_of
from fuzz.verdict import VARIANT, examine

import psdr_jit  # noqa: F401  (registers the plugins)

KINDS = {"": case_of, "specular": specular_case_of, "bidirectional": bidirectional_case_of,
         "curved": curved_case_of, "bent": bent_case_of}  # fmt: skip


def main(first: int, count: int, kind: str = "") -> None:
    for seed in range(first, first + count):
        case = KINDS[kind](seed)
        outcome = examine(case)
        spec = case["integrator"]
        print(f"{seed:5d} {outcome.seconds:6.1f} s  {outcome.word:22s} {case['param']} {case['how']} {spec['form']} "
              f"{spec['max_depth']}: {outcome.text}", flush=True)  # fmt: skip


if __name__ == "__main__":
    mi.set_variant(VARIANT)
    mi.set_log_level(mi.LogLevel.Error)
    main(*(int(word) for word in sys.argv[1:3]), *sys.argv[3:])
