"""What a person looks at after a run: pictures and one page, made from the files of a run folder."""
