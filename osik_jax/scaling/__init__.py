"""Batches over all devices of one or several hosts, and batches larger than memory; import it by name."""

from ._chunks import run_in_chunks as run_in_chunks
from ._saved import load as load
from ._sharded import sharded as sharded
