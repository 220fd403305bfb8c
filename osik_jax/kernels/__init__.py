"""Kernels that propose answers; what they propose is certified, and differentiated, in JAX."""
