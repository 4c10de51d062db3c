"""Reference results: what is known of every closed-loop instance, and by what evidence."""
