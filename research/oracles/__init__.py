"""The search for D-optimal inputs, and the bounds that certify them."""
