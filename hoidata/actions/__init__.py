"""What an object does in a clip, and what a verb asks of it: for figures, and for motions that are drawn again."""
