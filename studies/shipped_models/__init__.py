"""The shipped models found again: from the papers' experiments, from drives, and from models whose truth is known."""
