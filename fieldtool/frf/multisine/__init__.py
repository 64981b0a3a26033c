"""From periodic recordings to phasors, responses, noise and distortion."""
