"""The stages: each a function from values to one value of `types.stages`. None knows another, nor the cache."""
