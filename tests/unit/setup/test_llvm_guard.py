"""An LLVM that cannot compile is met with an error before it ends the process. Each case has a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from psdr_jit.setup import llvm, llvm_guard

BROKEN = """
import psdr_jit, mitsuba as mi
from psdr_jit.setup import llvm
llvm.is_fresh = lambda choice: False
llvm.probe = lambda path: llvm.Verdict(path, None, "aborts while compiling")
"""


def python(code: str, **environment: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120,
                          env={**os.environ, **environment})  # fmt: skip


@pytest.mark.parametrize("then", [
    pytest.param("mi.set_variant('llvm_ad_rgb')", marks=pytest.mark.slow),
    "from psdr_jit import scene_io; scene_io.use_variant('llvm_ad_mono')",
])  # fmt: skip
def test_setting_a_variant_says_how_to_get_an_llvm(then):
    done = python(BROKEN + then)
    assert done.returncode == 1, "ended in some other way than by an exception"
    assert "SetupError: no LLVM that works for Dr.Jit" in done.stderr and "aborts while compiling" in done.stderr
    assert "install one:" in done.stderr


def test_other_variants_do_without():
    assert python(BROKEN + "mi.set_variant('scalar_rgb')").returncode == 0


def test_import_warns_where_no_backend_can_be_loaded():
    done = python("import psdr_jit", DRJIT_LIBLLVM_PATH="/nonexistent/libLLVM.so", CUDA_VISIBLE_DEVICES="")
    assert done.returncode == 0
    assert "SetupWarning: DRJIT_LIBLLVM_PATH=/nonexistent/libLLVM.so cannot be loaded" in done.stderr
    assert "install one:" in done.stderr


@pytest.mark.usefixtures("llvm")
def test_the_library_of_a_working_process_passes():
    assert llvm_guard.loaded_library() is None or "libLLVM" in llvm_guard.loaded_library()
    llvm_guard.require_working_llvm("llvm_ad_rgb")


def test_a_broken_library_of_this_system_is_named():
    """The real thing, where there is one: LLVM 15 aborts on machines with AVX-512."""
    bad = [path for path in candidates() if llvm_aborts(path)]
    if not bad:
        pytest.skip("every LLVM of this system works")
    done = python("import psdr_jit, mitsuba as mi; mi.set_variant('llvm_ad_rgb')", DRJIT_LIBLLVM_PATH=bad[0])
    assert done.returncode == 1 and f"SetupError: DRJIT_LIBLLVM_PATH={bad[0]} does not work" in done.stderr


def candidates() -> list[str]:
    return [path for path in llvm.candidates() if llvm.major_version(path) >= 15]


def llvm_aborts(path: str) -> bool:
    return llvm.probe(path).reason.startswith("aborts")
