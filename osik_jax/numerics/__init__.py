"""Array helpers, and checks and conversions of a user's numbers; independent of robots and solvers."""
