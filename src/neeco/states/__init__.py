"""Answers to where an instrument is: recorded states corrected by images, with one verdict and one uncertainty each.

Before a scene exists, outlines of the stated links are fitted to the images' colours (`outline_model`, `outline_fit`,
`outline_states`); once it does, renderings are (`fitter`, and `alignment` for scoring, which renders the whole scene).
While training, `refinement` holds the corrections and verdicts, `search` sizes the errors of all states, and
`contradictions` finds single wrong ones; `prediction` tells what new states inherit.
"""
