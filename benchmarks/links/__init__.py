"""What a cycle costs on each link, beside the bare library."""
