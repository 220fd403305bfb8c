// Reader of the section "core" of a controller's file: one line of JSON, written by control/_packed_step.py.
//
// It is no reader for JSON in general, so that the library needs nothing but a compiler. What the numbers mean is checked
// after (layout_check.hpp).
#pragma once
#include <cmath>
#include <cstdio>
#include <cstring>
#include <locale>
#include <sstream>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

namespace osik {

// A value: a number (true and false are 1 and 0), a text, or items, which in an object have keys.
struct Json {
  double number = 0;
  std::string text;
  std::vector<std::string> keys;
  std::vector<Json> items;

  const Json* find(const char* key) const {
    for (size_t i = 0; i < keys.size(); ++i)
      if (keys[i] == key) return &items[i];
    return nullptr;
  }
  const Json& operator[](const char* key) const {
    if (const Json* found = find(key)) return *found;
    throw std::runtime_error(std::string("its section \"core\" has no \"") + key + "\"");
  }
  template <class T> std::vector<T> numbers() const {
    std::vector<T> all;
    for (const Json& item : items) {
      if constexpr (std::is_integral_v<T>)
        if (!(std::fabs(item.number) < 2147483648.0) || item.number != T(item.number))
          throw std::runtime_error("its section \"core\" has a number that is no integer");
      all.push_back(T(item.number));
    }
    return all;
  }
  std::vector<std::string> texts() const {
    std::vector<std::string> all;
    for (const Json& item : items) all.push_back(item.text);
    return all;
  }
};

class JsonReader {
  const char* at;  // of a text that ends with a zero
  std::istringstream stream;

 public:
  explicit JsonReader(const char* text) : at(text) { stream.imbue(std::locale::classic()); }  // 0.5, wherever we are
  Json value(int depth = 0) {
    Json found;
    if (depth > 4) fail();  // deeper than Python writes: each level takes space of the stack
    skip();
    if (*at == '"') found.text = text();
    else if (*at == '[' || *at == '{') {
      const bool is_object = *at++ == '{';
      for (char end = is_object ? '}' : ']'; !take(end); take(',')) {
        if (is_object) found.keys.push_back(text()), expect(':');
        found.items.push_back(value(depth + 1));
      }
    } else found.number = number();
    return found;
  }

 private:
  [[noreturn]] static void fail() { throw std::runtime_error("its section \"core\" cannot be read"); }
  void skip() { at += std::strspn(at, " \n"); }
  bool take(char wanted) {
    skip();
    return *at == wanted && ++at;
  }
  void expect(char wanted) {
    if (!take(wanted)) fail();
  }
  std::string text() {
    expect('"');
    std::string found;
    for (; *at && *at != '"'; ++at) found += *at == '\\' ? escaped() : *at;
    expect('"');
    return found;
  }
  char escaped() {  // Python escapes quotes, backslashes and control characters alone
    constexpr char SIGNS[] = "\"\\/bfnrt", MEANT[] = "\"\\/\b\f\n\r\t";
    ++at;
    if (*at == 'u') {
      if (std::strspn(at + 1, "0123456789abcdef") < 4) fail();
      return at += 4, char(std::stoi(std::string(at - 3, 4), nullptr, 16));
    }
    const char* sign = *at ? std::strchr(SIGNS, *at) : nullptr;
    if (!sign) fail();
    return MEANT[sign - SIGNS];
  }
  double number() {
    static const std::pair<const char*, double> WORDS[] = {
        {"Infinity", HUGE_VAL}, {"-Infinity", -HUGE_VAL}, {"true", 1}, {"false", 0}};
    for (const auto& [word, meant] : WORDS)
      if (!std::strncmp(at, word, std::strlen(word))) return at += std::strlen(word), meant;
    const size_t length = std::strspn(at, "+-.0123456789eE");
    double found = 0;
    stream.clear(), stream.str(std::string(at, length));
    if (!(stream >> found) || stream.peek() != EOF) fail();
    at += length;
    return found;
  }
};
}  // namespace osik
