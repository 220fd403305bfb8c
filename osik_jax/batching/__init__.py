"""Batches by name: which arrays have the batch's axis, and the numbers of a pytree by name."""

from ._batches import batch_axes as batch_axes
from ._batches import batched as batched
from ._batches import stack as stack
