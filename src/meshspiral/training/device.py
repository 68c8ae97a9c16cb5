"""The device of a process: accelerator, precision, threads and memory."""

from __future__ import annotations

import contextlib
import ctypes

import torch

from meshspiral.experiment.schema import ConfigError


def device_of(accelerator: str) -> str:
    """Torch's name of an accelerator.

    Args:
        accelerator: "cpu" or "gpu".

    Raises:
        ConfigError: Another accelerator, or no GPU on this machine.
    """
    if accelerator not in ("cpu", "gpu"):
        raise ConfigError(f"accelerator must be cpu or gpu, got {accelerator}")
    if accelerator == "gpu" and not torch.cuda.is_available():
        raise ConfigError("accelerator=gpu, but torch finds no GPU")
    return "cuda" if accelerator == "gpu" else "cpu"


def choose_precision(wanted: str, accelerator: str) -> str:
    """Lightning's name of a precision.

    Args:
        wanted: "32", "64", "bf16", or "auto": bf16 where the hardware multiplies it, else 32.
        accelerator: "cpu", or anything else for a GPU.
    """
    if wanted == "auto":
        if accelerator == "cpu":
            checks = [
                getattr(torch.cpu, f"_is_{name}_supported", bool)
                for name in ("avx512_bf16", "amx_tile")
            ]
            native = any(check() for check in checks)
        else:
            native = torch.cuda.is_available() and torch.cuda.is_bf16_supported()
        wanted = "bf16" if native else "32"
    return {"32": "32-true", "64": "64-true", "bf16": "bf16-mixed"}[wanted]


def set_up_process(threads: int | None = None, keep_memory: bool = False) -> None:
    """Prepare this process for tensor operations on the processor.

    Args:
        threads: Number of threads; None leaves it as it is (one per core).
        keep_memory: Reuse the memory of freed tensors, see `keep_freed_memory`.
    """
    if threads:
        torch.set_num_threads(threads)
    torch.set_flush_denormal(True)  # denormal probabilities slow the softmax down tenfold
    if keep_memory:
        keep_freed_memory()


def keep_freed_memory() -> None:
    """Make the C library keep the memory of large tensors for later tensors of this process.

    By default it returns each large block to the system, which clears and maps every page again:
    a tenth of a training step of LSTM-NET. Has no effect on other C libraries than GNU's.
    """
    with contextlib.suppress(OSError, AttributeError):
        mallopt = ctypes.CDLL("libc.so.6").mallopt
        mallopt(-4, 0)  # M_MMAP_MAX: take large blocks from the heap too
        mallopt(-1, 2**31 - 1)  # M_TRIM_THRESHOLD: never shrink the heap
