import pytest

pytest.register_assert_rewrite("tests.check_env.judging")
