"""Where reference motions are made: readers, retargeting, authoring, annotation, validation, recording, viewers."""
