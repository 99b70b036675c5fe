"""Is a converted clip sound? Measures of every clip and object mesh, limits on them, and what is left out for it."""
