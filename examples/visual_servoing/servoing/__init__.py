"""A real visual-servoing loop for the live runtime: a camera in the hand of an arm follows a tag.

`sensing` takes the picture (`camera`), `perception` finds the tag in it, `planning`
solves a model-predictive step, `control` makes of the plan the velocity for now, and the arm of
`arm` moves, which changes the next picture. The arm and the camera are processes of
their own: what ties them together is the world they stand in (`world`), not the network.

Everything is in metres, radians, seconds and nanoseconds of one monotonic clock, and a function of
time and seed alone.
"""
