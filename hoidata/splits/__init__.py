"""Train, validation and test splits: rules, named splits stored as JSON, leak check, training statistics."""
