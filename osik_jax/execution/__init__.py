"""How a batch runs: blocks of lanes, precision, backends, derivative rules, the CPU's workers. Knows no problem."""
