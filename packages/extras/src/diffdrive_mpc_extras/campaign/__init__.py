"""Campaigns: many runs drawn from distributions, each stored under the hash of its definition."""
