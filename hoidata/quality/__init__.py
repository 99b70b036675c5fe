"""Quality control: measures of each clip and object mesh, limits on them, and the clips that they exclude."""
