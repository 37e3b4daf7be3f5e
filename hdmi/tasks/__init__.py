"""The tasks of conf/task: catalogue, smoke test, pictures."""
