"""`hoidata export`: stores in the formats of other projects, with the licence of each array."""
