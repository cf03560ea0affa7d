"""Output-error estimation of linear systems with dead time: parameters and covariance from sampled experiments."""
