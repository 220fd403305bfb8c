"""Speed beside the peers, measured in one run on one machine; from the root of the repository."""
