"""The matrix products of a step: recorded while it runs, then replayed alone."""

from __future__ import annotations

from collections import Counter
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from meshspiral.benchmarking.measure import Action

MATRIX_PRODUCTS = ("mm", "addmm", "addmm_", "bmm", "baddbmm", "baddbmm_")


class Product(NamedTuple):
    """A matrix product [batch, rows, inner] x [batch, inner, columns]."""

    batch: int
    rows: int
    inner: int
    columns: int
    dtype: torch.dtype

    @property
    def operations(self) -> int:
        """Number of multiplications and additions."""
        return 2 * self.batch * self.rows * self.inner * self.columns


class ProductRecorder(TorchDispatchMode):
    """Records the matrix products that run while it is active, in the backward pass too.

    Every product that PyTorch computes by mm, bmm and their variants is recorded, Fourier
    transforms by a product with their basis included. A convolution is recorded as the products
    that it is equivalent to. Products within fused kernels, such as those of attention, are not
    seen.

    Attributes:
        products: How often each product ran.
    """

    def __init__(self) -> None:
        super().__init__()
        self.products: Counter[Product] = Counter()

    @property
    def operations(self) -> int:
        """Number of multiplications and additions of all products."""
        return sum(count * product.operations for product, count in self.products.items())

    def __torch_dispatch__(
        self, function: Any, types: Any, args: tuple = (), kwargs: dict | None = None
    ) -> Any:
        out = function(*args, **(kwargs or {}))
        name = function.overloadpacket.__name__
        if name in MATRIX_PRODUCTS:
            a, b = [x for x in args if isinstance(x, Tensor)][-2:]  # addmm has a summand before
            batch = len(a) if a.ndim == 3 else 1
            self.products[Product(batch, *a.shape[-2:], b.shape[-1], a.dtype)] += 1
        elif name == "convolution":
            x, weight, *_, transposed, _, groups = args
            forward, _, _ = _convolution(weight, x, out, transposed, groups)
            self.products[forward] += 1
        elif name == "convolution_backward":
            grad, x, weight, *_, transposed, _, groups, mask = args
            _, *gradients = _convolution(weight, x, grad, transposed, groups)
            self.products.update(p for p, wanted in zip(gradients, mask, strict=False) if wanted)
        return out


def _convolution(
    weight: Tensor, x: Tensor, out: Tensor, transposed: bool, groups: int
) -> tuple[Product, Product, Product]:
    """The products equivalent to a convolution and to its gradients by input and by weight.

    Args:
        weight: [A, B, *kernel], where A counts channels of `out`, or of `x` if transposed.
        x: The input [batch, channels, *size].
        out: The output [batch, channels, *size].
    """
    grid = x if transposed else out
    positions = grid.numel() // grid.shape[1]
    rows, inner = len(weight) // groups, weight[0].numel()
    product = Product(groups, rows, inner, positions, weight.dtype)
    adjoint = Product(groups, inner, rows, positions, weight.dtype)
    by_weight = Product(groups, rows, positions, inner, weight.dtype)
    return (adjoint, product, by_weight) if transposed else (product, adjoint, by_weight)


def replay(products: Counter[Product], device: str) -> Action:
    """An action that computes products of these shapes, of random matrices, and nothing else.

    Products of one dtype share their memory, so that the action takes that of the largest alone.
    """
    calls = []
    for dtype in {product.dtype for product in products}:
        mine = [product for product in products if product.dtype == dtype]
        shapes = [_shapes(product) for product in mine]
        sizes = [max(map(torch.Size.numel, role)) for role in zip(*shapes, strict=True)]
        memory = [torch.randn(size, device=device).to(dtype) for size in sizes]
        for product, shape in zip(mine, shapes, strict=True):
            a, b, out = (
                buffer[: size.numel()].view(size)
                for buffer, size in zip(memory, shape, strict=True)
            )
            multiply = torch.bmm if a.ndim == 3 else torch.mm
            calls.append((products[product], multiply, a, b, out))

    def action() -> None:
        for count, multiply, a, b, out in calls:
            for _ in range(count):
                multiply(a, b, out=out)

    return action


def _shapes(product: Product) -> list[torch.Size]:
    """The shapes of both factors and of the product, without a batch of one."""
    batch, rows, inner, columns, _ = product
    leading = (batch,) if batch > 1 else ()
    sizes = ((rows, inner), (inner, columns), (rows, columns))
    return [torch.Size((*leading, *size)) for size in sizes]
