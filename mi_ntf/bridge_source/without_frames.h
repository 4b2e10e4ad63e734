/// Errors in one sentence: Python's frames are cut from what a C++ program prints.
#pragma once

#include <algorithm>
#include <iostream>
#include <streambuf>
#include <string>

namespace mi_ntf {

/**
 * nanobind's `what()` of a Python exception is "Traceback (most recent call last):", a few indented lines, and only
 * then the error. What remains here is the error, and for faults of the program a hint at the switch.
 */
inline std::string without_frames(std::string text) {
    const std::string head = "Traceback (most recent call last):\n", ours = "MiNtfError: ";
    for (size_t begin; (begin = text.find(head)) != std::string::npos;) {
        size_t end = begin + head.size();
        while (text.compare(end, 2, "  ") == 0) {
            size_t newline = text.find('\n', end);
            end = newline == std::string::npos ? text.size() : newline + 1;
        }
        text.erase(begin, end - begin);
        if (text.compare(begin, ours.size(), ours) == 0) {
            text.erase(begin, ours.size());
        } else {  // Dr.Jit explains at length what only its callers can mend
            text.resize(std::min(text.size(), text.find("\n\n", begin)));
            text += " (MI_NTF_DEBUG=1 shows where)";
        }
    }
    return text;
}

/// Stands before the buffer of a stream.
class WithoutFrames : public std::streambuf {
public:
    explicit WithoutFrames(std::ostream &stream) : m_target(stream.rdbuf()) { stream.rdbuf(this); }

protected:
    /// The program hands over an error's whole text in one piece.
    std::streamsize xsputn(const char *text, std::streamsize size) override {
        std::string rest = without_frames(std::string(text, size_t(size)));
        m_target->sputn(rest.data(), std::streamsize(rest.size()));
        return size;
    }
    int_type overflow(int_type c) override {
        return traits_type::eq_int_type(c, traits_type::eof()) ? sync() : m_target->sputc(traits_type::to_char_type(c));
    }
    int sync() override { return m_target->pubsync(); }

private:
    std::streambuf *m_target;
};

} // namespace mi_ntf
