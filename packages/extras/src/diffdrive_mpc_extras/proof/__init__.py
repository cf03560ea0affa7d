"""Proof of a controller: how often it fails, how far it is off at worst, and where it stops to hold."""
