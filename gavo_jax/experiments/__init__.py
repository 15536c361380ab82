"""Many runs: what is planned, who runs it, where the results go, what they say."""
