"""What everything else may use: errors, exact numbers, devices, threads, randomness, progress, the environment."""
