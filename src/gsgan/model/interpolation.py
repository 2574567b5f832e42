"""Values at a few controls, interpolated at many points."""

from typing import Any, NamedTuple

import torch
from scipy.sparse import csr_matrix
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional


class _Kept(NamedTuple):
    """The transpose of an interpolation, and the tensors that it was made of."""

    made_of: tuple[Any, ...]
    transpose: csr_matrix


class Interpolation:
    """Averages of controls' values at points.

    The gradient of a lookup sorts all of its indices in every iteration. Points keep their
    controls, so here the transposed matrix is made once and multiplied. On a GPU, and in half
    precision, a lookup's own gradient is used.
    """

    def __init__(self) -> None:
        self._kept: _Kept | None = None

    def __call__(
        self,
        values: Tensor,
        near: Tensor,
        share: Tensor,
        chosen: Tensor | None = None,
    ) -> Tensor:
        """``[M, C]`` of the controls' values ``[A, C]``; differentiable in them.

        Args:
            values: of the controls.
            near: ``[N, k]`` int64, the controls of each point.
            share: ``[N, k]`` their weights.
            chosen: ``[M]`` int64, points; None: all of them.
        """
        # The rows of the points that are wanted.
        share = share.to(values.dtype)
        rows = near
        weights = share
        if chosen is not None:
            rows = near[chosen]
            weights = share[chosen]

        # On a CPU the gradient multiplies the transpose, in precisions that scipy has.
        trained = torch.is_grad_enabled() and values.requires_grad
        is_float = values.dtype in (torch.float32, torch.float64)
        if trained and is_float and values.device.type == "cpu":
            transpose = self._transpose(near, share, len(values))
            result: Tensor = _Interpolated.apply(
                values, rows, weights, chosen, transpose
            )
            return result
        return functional.embedding_bag(
            rows, values, per_sample_weights=weights, mode="sum"
        )

    def _transpose(
        self, near: Tensor, share: Tensor, controls: int
    ) -> csr_matrix:
        """``[A, N]``, made anew if a table has changed."""
        made_of = (near.data_ptr(), near._version, share.dtype, controls)
        if self._kept is None or self._kept.made_of != made_of:
            matrix = interpolation_matrix(near, share, controls)
            self._kept = _Kept(made_of, matrix.T.tocsr())
        return self._kept.transpose


def interpolation_matrix(
    near: Tensor, share: Tensor, controls: int
) -> csr_matrix:
    """``[N, A]``: its product with the controls' values are the values at the points.

    Args:
        near: ``[N, k]`` int64, the controls of each point.
        share: ``[N, k]`` their weights.
        controls: A.
    """
    points = torch.arange(len(near)).repeat_interleave(near.shape[1])
    at = (points.numpy(), near.flatten().numpy())
    return csr_matrix((share.flatten().numpy(), at), (len(near), controls))


class _Interpolated(torch.autograd.Function):
    """A weighted lookup, whose gradient is the product of its transpose."""

    @staticmethod
    def forward(
        ctx: Any,
        values: Tensor,
        rows: Tensor,
        weights: Tensor,
        chosen: Tensor | None,
        transpose: csr_matrix,
    ) -> Tensor:
        ctx.chosen = chosen
        ctx.transpose = transpose
        return functional.embedding_bag(
            rows, values, per_sample_weights=weights, mode="sum"
        )

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        # Points that were not chosen have no gradient.
        if ctx.chosen is not None:
            shape = (ctx.transpose.shape[1], gradient.shape[1])
            every = gradient.new_zeros(shape)
            gradient = every.index_add_(0, ctx.chosen, gradient)
        gradients = torch.from_numpy(ctx.transpose @ gradient.numpy())
        return gradients, None, None, None, None
