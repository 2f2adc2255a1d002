"""What is kept on disk, and how is it never lost?"""
