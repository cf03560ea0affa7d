"""Output-error estimation of linear systems with dead time: from experiments to parameters with their covariance."""
