"""Raw files of one dataset to a clip store, by its adapter, in processes that may be killed."""
