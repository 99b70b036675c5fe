"""How far two contact maps agree."""

import numpy as np


def f1_score(made: np.ndarray, true: np.ndarray) -> float:
    """F1 of boolean maps (point,): 2 TP / (2 TP + FP + FN); 1 where both are empty."""
    total = int(made.sum()) + int(true.sum())
    return 2 * int((made & true).sum()) / total if total else 1.0
