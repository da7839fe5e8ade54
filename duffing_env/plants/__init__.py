"""The Silverbox circuit: its record, and the twin identified from the record."""
