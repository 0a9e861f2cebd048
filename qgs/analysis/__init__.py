"""Looking at models and what they make: traces, reconstructions, pictures, reports."""
