"""Online and offline inference: filters, noise hypotheses, Fisher information, and offline fits."""
