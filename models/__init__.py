"""Model families on annotated clips: ``registry`` names them, ``common`` is what they share, a folder each holds them.

What the pipelines use: ``registry.load_family`` and ``load_network``; ``common.training.train_network`` writes a
checkpoint, ``common.predicting.sample_family`` a store of clips, ``text2hoi.generation.generate`` a motion for a text.
"""
