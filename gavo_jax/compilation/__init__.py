"""Which JAX is fit, how its programs are made, where they are kept, and how long they are waited for."""
