"""Files on disk: whole-file writes, locks, run folders, checkpoints, campaign results."""
