"""Drawing: tensors to pictures, queries over photos, labelled figures."""
