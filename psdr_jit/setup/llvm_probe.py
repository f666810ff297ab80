"""Child process that decides whether one libLLVM can compile Dr.Jit's kernels.

Run as `python llvm_probe.py LIBRARY [FOLDER]`; what LIBRARY needs and the system lacks comes from FOLDER.
Asking for the version is not enough: LLVM 15 loads, reports its version and then *aborts the process* on
AVX-512 machines ("Cannot select: fminimum"). So the question has to be asked by compiling a kernel, and in
a process that may die. Prints one line of JSON on success; any other end means "not usable".

Run by path, so that the child imports neither psdr_jit nor Mitsuba.
"""

from __future__ import annotations

import ctypes
import json
import sys
from pathlib import Path

MAX_MISSING = 64  # libraries one libLLVM may lack before we call the search a loop


def load_with_dependencies(library: Path, folder: Path | None) -> list[str]:
    """Load `library`, taking what the system lacks from `folder`; return those files in load order.

    The loader names one missing library at a time ("libedit.so.2: cannot open shared object file"), so we
    load that one by full path and try again. Afterwards the loader finds it by its SONAME. Libraries that
    the system has are left alone: two versions of one library in a process are asking for trouble. They
    are loaded without RTLD_GLOBAL so that their symbols do not shadow those of other extension modules.
    """
    loaded: list[str] = []
    for _ in range(MAX_MISSING):
        try:
            ctypes.CDLL(str(library))
            return loaded
        except OSError as error:
            missing = str(error).split(":", 1)[0].strip()
            local = folder / missing if folder and "/" not in missing else None
            if local is None or not local.is_file() or str(local) in loaded or local == library:
                raise
        loaded += load_with_dependencies(local, folder)
        loaded.append(str(local))
    raise OSError(f"{library}: more than {MAX_MISSING} libraries are missing")


def run_kernel() -> float:
    """Compile and run the constructs on which bad LLVM versions were seen to fail; return a checksum.

    Covers minimum/clip in both precisions (fminimum), a recorded loop, gather, scatter-add, a half-precision
    conversion and forward-mode AD. The expected value is recomputed in plain Python by the caller.
    """
    import drjit as dr
    from drjit.llvm.ad import Float, Float16, Float64, UInt32

    size = 1000
    index = dr.arange(UInt32, size)
    table = Float(index) * 0.5

    def body(i: UInt32, total: Float) -> tuple[UInt32, Float]:
        return i + 1, total + dr.clip(dr.gather(Float, table, (index + i) % size), 1.0, 20.0)

    _, total = dr.while_loop((UInt32(0), dr.zeros(Float, size)), lambda i, _: i < 4, body)
    x = dr.minimum(total, 60.0) + Float(dr.maximum(Float64(total), 30.0))
    x += Float(dr.minimum(Float16(table), Float16(8)))
    bins = dr.zeros(Float, 4)
    dr.scatter_reduce(dr.ReduceOp.Add, bins, x, index % 4)
    theta = Float(2)
    dr.enable_grad(theta)
    y = dr.sum(dr.minimum(theta * table, 100.5))  # off the tie, where the derivative is a convention
    dr.forward(theta)
    return float(dr.sum(bins)[0]) + float(dr.grad(y)[0])


def expected() -> float:
    """The value of `run_kernel` in plain Python."""
    size, out = 1000, 0.0
    for k in range(size):
        total = sum(min(max(0.5 * ((k + i) % size), 1.0), 20.0) for i in range(4))
        out += min(total, 60.0) + max(total, 30.0) + min(0.5 * k, 8.0)
        out += 0.5 * k if k <= 100 else 0.0  # derivative of min(theta k / 2, 100.5) at theta = 2
    return out


def main(argv: list[str]) -> int:
    """Probe `argv[0]`; dependencies may come from the folder `argv[1]`."""
    library = Path(argv[0])
    if sys.platform != "win32":
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # an abort is an answer, not an event to record
    preload = load_with_dependencies(library, Path(argv[1]) if len(argv) > 1 else None)
    import drjit as dr

    if not dr.has_backend(dr.JitBackend.LLVM):
        print("Dr.Jit refuses this library (it needs LLVM 15 or newer)", file=sys.stderr)
        return 1
    version = ".".join(str(part) for part in dr.detail.llvm_version())
    value, want = run_kernel(), expected()
    if abs(value - want) > 1e-3 * want:
        print(f"a compiled kernel computed {value} instead of {want}", file=sys.stderr)
        return 1
    print(json.dumps({"version": version, "preload": preload}))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
