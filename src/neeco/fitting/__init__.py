"""States fitted to images by rendering: the parameters, priors, residual and minimiser that all fits share."""
