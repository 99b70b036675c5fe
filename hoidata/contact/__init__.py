"""Contact between hands and objects: acting hands, contact maps, sparse distance maps."""
