"""From measured directions to states with honest covariances."""
