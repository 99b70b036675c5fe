"""The evaluator: classifiers and a text-motion pair encoder that tell what a motion shows. Never trained on samples."""
