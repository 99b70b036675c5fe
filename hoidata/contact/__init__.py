"""Contact between hands and objects: active hands, contact maps, sparse distance maps."""
