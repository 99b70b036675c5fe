"""Model families on annotated clips: ``registry`` lists them, ``common`` has what they share, each has a folder.

Entry points: ``registry.load_family`` and ``load_network``; ``common.training.train_network`` writes a checkpoint,
``common.predicting.sample_family`` a store of clips, ``text2hoi.generation.generate`` a motion for a text.
"""
