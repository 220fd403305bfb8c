"""Execution of batches: blocks of lanes, precision, backends, derivative rules, the CPU's workers. Knows no problem."""
