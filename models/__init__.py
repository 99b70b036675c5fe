"""Text2HOI's four networks on annotated clips: contact, length, diffusion, refiner; training, evaluation, generation.

For the pipelines, and nothing else is needed from there:

- ``models.common.training.train_model(model_name, annotated_root, out_folder, params, hands, provenance, upstream)``
  writes ``model.safetensors`` and ``log.csv``, or ``empty.json`` with a reason where no clip can be trained on. The
  *diffusion* stage needs the checkpoint folder of *contact* (its object features), and the *refiner* that of
  *diffusion* (which carries what it needs of contact): ``upstream={"contact": folder}`` and ``{"diffusion": folder}``.
- ``models.common.evaluation.evaluate_dataset(annotated_root, checkpoints, out_json, params, hands)``.
- ``models.text2hoi.generation.generate(text, object, checkpoints, hands, encoder, seed)``.

``provenance`` is a function of the facts a training knows (model, size, seed, clips by split, synthetic, ...) that
gives the dictionary to store: ``lambda facts: build_provenance(root, stage, facts)``.
"""
