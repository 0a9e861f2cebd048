"""Data tools: check data sets (`qgs data check`) and convert them to chunks (`qgs data pack`)."""
