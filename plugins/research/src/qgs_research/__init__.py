"""Studies, benchmarks, and import of published weights."""
