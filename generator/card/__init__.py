"""The data card: what the dataset holds and what is known of it, made from the dataset itself."""
