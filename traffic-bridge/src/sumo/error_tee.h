// Reads what SUMO writes to standard error.
#pragma once

#include <cstddef>
#include <iostream>
#include <streambuf>
#include <string>
#include <utility>

namespace caraware {

// Forwards std::cerr and keeps the end of the text: libsumo's exceptions often say "Process Error" and nothing else.
class ErrorTee : public std::streambuf {
public:
    ErrorTee() : original_(std::cerr.rdbuf(this)) {}
    ~ErrorTee() override { std::cerr.rdbuf(original_); }

    std::string take() { return std::exchange(text_, std::string()); }

protected:
    int_type overflow(int_type symbol) override {
        if (!traits_type::eq_int_type(symbol, traits_type::eof())) {
            const char letter = traits_type::to_char_type(symbol);
            keep(&letter, 1);
            original_->sputc(letter);
        }
        return traits_type::not_eof(symbol);
    }
    std::streamsize xsputn(const char* text, std::streamsize count) override {
        keep(text, static_cast<std::size_t>(count));
        return original_->sputn(text, count);
    }
    int sync() override { return original_->pubsync(); }

private:
    static constexpr std::size_t KEPT_BYTES = 8192;

    void keep(const char* text, std::size_t count) {
        text_.append(text, count);
        if (text_.size() > 2 * KEPT_BYTES) {
            text_.erase(0, text_.size() - KEPT_BYTES);
        }
    }

    std::string text_;
    std::streambuf* original_;
};

}  // namespace caraware
