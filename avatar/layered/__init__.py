"""The avatar as a stack of surfaces: offset shells of the posed mesh with opacity, composited front to back."""
