"""Pictures as uint8 arrays (H, W, 3): renders, depth, tokens, anchors, attention; and figures."""
