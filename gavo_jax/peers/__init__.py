"""Other libraries' odometries in the same terms, behind the same driver."""
