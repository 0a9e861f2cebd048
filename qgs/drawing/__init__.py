"""Drawing of tensors as pictures and figures."""
