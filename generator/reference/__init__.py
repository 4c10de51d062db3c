"""Reference results: what is known of every instance, and by what evidence."""
