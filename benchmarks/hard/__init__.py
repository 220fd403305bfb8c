"""Hard work: targets beyond reach, targets that jump, a stretched arm, a squat; ours and the peers, judged alike."""
