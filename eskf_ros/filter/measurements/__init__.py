"""One file per aid: prediction, innovation, Jacobian, noise; nothing else."""
