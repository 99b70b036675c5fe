"""What tests are made of: one object, one clip, one annotated store. Import these, not a conftest."""
