"""From a clip to its words: sentences, hand type, text features; and from a user's words back to the hand."""
