"""Where kernels of the CUDA backend put what does not fit into registers."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def spill_to_local_memory() -> None:
    """Have CUDA kernels of this thread spill registers to local memory.

    Dr.Jit asks for shared memory instead (`JitFlag.SpillToSharedMemory`) where driver and device know of it. But a
    kernel that calls functions, as do all that look at BSDFs or emitters, cannot have that: unless it traces rays, and
    so is compiled by OptiX, the assembler refuses it ("Smem spilling should not be enabled when functions use abi") and
    Dr.Jit ends the process. The flag belongs to the thread, and stays off: kernels may run after a call has returned.
    """
    if mi.variant().startswith("cuda") and dr.flag(dr.JitFlag.SpillToSharedMemory):
        dr.set_flag(dr.JitFlag.SpillToSharedMemory, False)
