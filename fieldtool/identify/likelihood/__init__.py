"""Maximum likelihood: parameters, data with their covariance, the fit, and what to expect of it."""
