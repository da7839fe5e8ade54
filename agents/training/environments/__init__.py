"""Vector environments for training: with features, mixed, and of a family of oscillators."""
