"""Which clips train, validate and test: rules, named splits kept as data, leak check, training statistics."""
