"""How good a motion is: figures of predicted clips beside the clips they were made for; the one list of metrics."""
