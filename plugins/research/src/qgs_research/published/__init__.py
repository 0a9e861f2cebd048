"""Import of published weights as checkpoints of qgs."""
