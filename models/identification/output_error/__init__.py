"""Output-error estimation of linear systems with dead time from several stretches of data."""
