"""The model in rounds: cameras that correct their views, then a network in the world, again."""
