"""From poses to configurations: who finds them, how exactly, how fast."""
