"""Published weights become checkpoints of qgs: `importing` is `qgs import` in Python."""
