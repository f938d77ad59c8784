"""What a message of a failure looks like."""

from catalog.errors import MAX_LETTERS, ConfigError, NoSolutionError


def test_a_message_quotes_no_name_of_any_length() -> None:
    for error in (ConfigError, NoSolutionError):
        text = str(error(f"frames.csv: camera '{'1' * 10 * MAX_LETTERS}' has no file"))
        assert text.startswith("frames.csv: camera '111")
        assert text.endswith("' has no file")
        assert len(text) == MAX_LETTERS + len(" [...] ")


def test_a_message_that_can_be_read_stays() -> None:
    text = "/deep" * 300 + ": no such file; check the path"
    assert str(ConfigError(text)) == text
