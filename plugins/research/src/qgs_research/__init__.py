"""Studies, benchmarks, published weights."""
