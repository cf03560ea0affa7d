"""Proof of a controller: failure rates, worst-case errors, and the conditions under which it fails."""
