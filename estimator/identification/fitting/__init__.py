"""From nothing to a posterior: weak form, multistart, profile likelihood."""
