"""Instrument states: recorded states corrected by images, with one verdict and one uncertainty each.

Before a scene exists, outlines of the stated links are fitted to the images' colours (`outline_model`, `outline_fit`,
`outline_states`). Afterwards renderings are fitted (`fitter`; `alignment` for scoring, which renders the whole scene).
During training, `refinement` holds corrections and verdicts, `search` estimates the size of all errors,
`contradictions` detects single wrong states, and `prediction` transfers corrections to new states.
"""
