"""States fitted to images by rendering: the parameters, priors, residual and minimiser that all fits share.

A single frame is fitted by `alignment.align_frame` for scoring: state and camera, the whole scene rendered, any method.
It is fitted by `state_fitter.Fitter.fit` for tracking: the state alone, in a crop over tissue rendered once, which
takes a scene that keeps tissue and instruments apart. Both call `minimise`. Pixels that count as one observation (100
of each level's, 25 of the full size) were chosen separately.
"""
