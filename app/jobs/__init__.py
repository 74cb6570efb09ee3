"""Jobs: work in processes of its own, since Taichi frees no field; here or on a cluster."""
