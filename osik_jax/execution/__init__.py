"""Execution of batches: blocks of lanes, precision, backends, derivative rules, workers of the CPU client."""
